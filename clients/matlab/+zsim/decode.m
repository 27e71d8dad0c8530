function value = decode(text)
    % DECODE Decode JSON, with lists of numbers as rows.
    %
    % Rows are 1 x n, whereas jsondecode returns n x 1. Thus [0 0 1] - estimate.position_m is 1 x 3 rather than 3 x 3.
    % Lists of texts are n x 1 cells; lists of objects are n x 1 struct arrays, or cells if their fields differ. A list
    % of one number is that number.

    % A list within a list is decoded as a row of a matrix, so [1,2] after a name is replaced by [[1,2]]. In a text
    % every quote is preceded by a backslash, so the pattern never matches within one.
    value = jsondecode(regexprep(text, '(?<=[^\\]":)\[([^\[\]{}"]+)\]', '[[$1]]'));
end
