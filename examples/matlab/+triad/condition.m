function number = condition(c)
    % CONDITION Return the condition number of J^-1 (2-norm, in metres and radians).
    %
    % A formation larger than 4 m is scaled down to 4 m first, since it is no closer to singularity than a smaller one
    % of the same shape.
    LENGTH_M = 4;  % p and q of the paper's formation, equation (3)
    c(10:11) = c(10:11) * min(1, LENGTH_M / max([abs(c(10)), abs(c(11)), LENGTH_M]));
    number = cond(triad.inverse_jacobian(c));
end
