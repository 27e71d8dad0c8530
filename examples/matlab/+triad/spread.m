function spread_m = spread(c)
    % SPREAD Return sin(beta) min(p, q), the smaller height of the triangle on p and q [m]; 0 for a singular shape.
    spread_m = sin(c(12)) * min(c(10), c(11));
end
