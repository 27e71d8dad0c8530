function text = encode(value)
    % Return a value as JSON.
    %
    %   zsim.encode(struct('velocity_m_s', [1 0 0]))     {"velocity_m_s":[1,0,0]}
    %
    % A number is a number, a vector a list, a matrix a list of its rows; a cell is always a list, so that {1} is [1];
    % a struct or containers.Map is an object, a struct array a list of objects; NaN is null. Whole numbers are exact
    % up to 2^53: of nanoseconds, 104 days.
    %
    % Errors: zsim:argument for what JSON has no word for, such as a function handle.
    try
        text = jsonencode(value);
    catch reason
        error('zsim:argument', 'a %s cannot be sent (%s); use doubles, text, logicals, cells and structs', ...
            class(value), reason.message);
    end
    if ~isempty(regexp(text, '\d{9}\.0', 'once'))
        % Octave writes whole numbers from 999999999 on as 999999999.0, which is no integer to others; texts, the
        % first alternative, stay as they are.
        text = regexprep(text, '("(?:[^"\\]|\\.)*")|(\d{9,})\.0(?=[,\]}]|$)', '$1$2');
    end
end
