function d_m = least_distance(p_W)
    % LEAST_DISTANCE Return the smallest distance between two of three robots [m]; p_W is 3 x 3, one robot per row.
    d_m = min([norm(p_W(2, :) - p_W(1, :)), norm(p_W(3, :) - p_W(1, :)), norm(p_W(3, :) - p_W(2, :))]);
end
