function spread_m = spread(c)
    % Return sin(beta) min(p, q), the smallest height of the triangle [m]; 0 where the shape is singular.
    spread_m = sin(c(12)) * min(c(10), c(11));
end
