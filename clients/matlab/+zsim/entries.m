function list = entries(value)
    % Return a list of {"key", "value"}, as jsondecode gives it, as a struct array 1 x n with fields key and value.
    %
    % jsondecode gives a struct array, a cell of structs or, for an empty list, [].
    if isempty(value)
        list = struct('key', {}, 'value', {});
    elseif iscell(value)
        list = reshape([value{:}], 1, []);
    else
        list = reshape(value, 1, []);
    end
end
