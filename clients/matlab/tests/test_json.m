function test_json()
    % TEST_JSON Test that JSON has the form that the gateway expects, and values the form that users expect.
    assert(strcmp(zsim.encode(struct('velocity_m_s', [1 0 0])), '{"velocity_m_s":[1,0,0]}'));
    assert(strcmp(zsim.encode({'only'}), '["only"]'));
    assert(strcmp(zsim.encode({1}), '[1]'));
    assert(strcmp(zsim.encode({}), '[]'));
    assert(strcmp(zsim.encode([]), '[]'));
    assert(strcmp(zsim.encode([1; 2]), '[1,2]'));
    assert(strcmp(zsim.encode([1 2; 3 4]), '[[1,2],[3,4]]'));
    assert(strcmp(zsim.encode(nan), 'null'));
    assert(strcmp(zsim.encode(struct()), '{}'));
    assert(strcmp(zsim.encode(containers.Map({'left.p'}, {4})), '{"left.p":4}'));
    assert(strcmp(zsim.encode({struct('a', 1)}), '[{"a":1}]'));
    whole_numbers();
    rows();
    texts_stay();
    lists_of_entries();
    refused('zsim:argument', @() zsim.encode(@sin));
end

function whole_numbers()
    assert(strcmp(zsim.encode(struct('t_ns', 330000000000)), '{"t_ns":330000000000}'));
    assert(strcmp(zsim.encode([999999999, -2 ^ 53, 0.5]), '[999999999,-9007199254740992,0.5]'));
    text = '1234567890.0, "1234567890.0"]';
    assert(isequal(jsondecode(zsim.encode({text, 1234567890})), {text; 1234567890}));
    for exact = [pi, 1e-9 / 3, -123456.12345678901, 9876543210.125]
        assert(abs(jsondecode(zsim.encode(exact)) - exact) <= eps(exact));
    end
end

function rows()
    value = zsim.decode('{"v":[1,2,3],"t":[[1,2],[3,4]],"in":{"w":[4,5]},"l":[{"u":[6,7]},{"u":[8,9]}],"n":[1,null]}');
    assert(isequal(value.v, [1 2 3]));
    assert(isequal(value.t, [1 2; 3 4]));
    assert(isequal(value.in.w, [4 5]));
    assert(isequal(value.l(2).u, [8 9]));
    assert(isequaln(value.n, [1 nan]));
    value = zsim.decode('{"flags":[true,false],"none":[],"names":["a","b"],"gone":null,"one":[5]}');
    assert(isequal(value.flags, [true false]));
    assert(isempty(value.none) && isempty(value.gone));
    assert(isequal(value.names, {'a'; 'b'}));
    assert(isequal(value.one, 5));
end

function texts_stay()
    text = 'say "at":[1,2] or \":[3] and [4,5]';
    value = zsim.decode(zsim.encode(struct('text', text, 'v', [1 2])));
    assert(strcmp(value.text, text));
    assert(isequal(value.v, [1 2]));
end

function lists_of_entries()
    several = zsim.decode('{"values":[{"key":"a","value":{"x":[1,2]}},{"key":"b","value":3},{"key":"a","value":4}]}');
    list = zsim.entries(several.values);
    assert(isequal(size(list), [1 3]) && isequal(list(1).value.x, [1 2]));
    one = zsim.decode('{"values":[{"key":"a","value":5}]}');
    assert(isequal(size(zsim.entries(one.values)), [1 1]));
    assert(isempty(zsim.entries([])));
    assert(isequal(zsim.entries({list(1), list(2)}), list(1:2)));
    gate = struct('inputs', list);
    assert(isequal(zsim.heard(gate, 'a'), 4));
    assert(isempty(zsim.heard(gate, 'c')));
    assert(isempty(zsim.heard(struct('inputs', zsim.entries([])), 'a')));
end
