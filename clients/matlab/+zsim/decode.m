function value = decode(text)
    % Return JSON as values, lists of numbers as rows: 1 x n, where jsondecode gives n x 1.
    %
    % So [0 0 1] - estimate.position_m is a difference, and not a 3 x 3 table. Lists of texts are cells n x 1, lists of
    % objects struct arrays n x 1, or cells where their fields differ; a number alone in its list is that number.
    %
    % A list within a list is a row of a table, so [1,2] becomes [[1,2]] after a name. In a text no quote stands
    % without a backslash before it: what is replaced is never part of one.
    value = jsondecode(regexprep(text, '(?<=[^\\]":)\[([^\[\]{}"]+)\]', '[[$1]]'));
end
