function fault = place_fault(c, params)
    % PLACE_FAULT Return why the robots must not be at their positions in c, as a number for triad.reason; 0: they may.
    p_W = triad.robots(c);
    if triad.least_distance(p_W) < params.separation_min_m
        fault = 11;
    elseif min(p_W(:, 3)) < params.height_min_m
        fault = 12;
    else
        fault = 0;
    end
end
