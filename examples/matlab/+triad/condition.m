function number = condition(c)
    % Return the condition number of J^-1 (2-norm, metres and radians as they are); one larger than 4 m is judged as if
    % scaled down to it, since it is not nearer to singularity than a small one of the same shape.
    LENGTH_M = 4;  % p and q of the paper's formation, equation (3)
    c(10:11) = c(10:11) * min(1, LENGTH_M / max([abs(c(10)), abs(c(11)), LENGTH_M]));
    number = cond(triad.inverse_jacobian(c));
end
