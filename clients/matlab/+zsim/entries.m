function list = entries(value)
    % ENTRIES Return a decoded list of {"key", "value"} as a 1 x n struct array with fields key and value.
    %
    % jsondecode returns a struct array, a cell of structs or, for an empty list, [].
    if isempty(value)
        list = struct('key', {}, 'value', {});
    elseif iscell(value)
        list = reshape([value{:}], 1, []);
    else
        list = reshape(value, 1, []);
    end
end
