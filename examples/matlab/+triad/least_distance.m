function d_m = least_distance(p_W)
    % Return the least distance between two of three robots [m]; p_W 3 x 3, a robot a row.
    d_m = min([norm(p_W(2, :) - p_W(1, :)), norm(p_W(3, :) - p_W(1, :)), norm(p_W(3, :) - p_W(2, :))]);
end
