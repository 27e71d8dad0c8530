function text = encode(value)
    % ENCODE Encode a value as JSON.
    %
    %   zsim.encode(struct('velocity_m_s', [1 0 0]))     {"velocity_m_s":[1,0,0]}
    %
    % A scalar becomes a number, a vector a list, a matrix a list of its rows. A cell always becomes a list, e.g. {1}
    % becomes [1]. A struct or containers.Map becomes an object, a struct array a list of objects, and NaN null.
    % Integers are exact up to 2^53 (104 days in nanoseconds).
    %
    % Errors: zsim:argument for a value that JSON cannot represent, such as a function handle.
    try
        text = jsonencode(value);
    catch reason
        error('zsim:argument', 'a %s cannot be sent (%s); use doubles, text, logicals, cells and structs', ...
            class(value), reason.message);
    end
    if ~isempty(regexp(text, '\d{9}\.0', 'once'))
        % Octave writes integers from 999999999 on as 999999999.0, which other parsers do not read as integers. Texts,
        % the first alternative, are not changed.
        text = regexprep(text, '("(?:[^"\\]|\\.)*")|(\d{9,})\.0(?=[,\]}]|$)', '$1$2');
    end
end
