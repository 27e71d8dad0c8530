function fault = place_fault(c, params)
    % Return why the robots may not stand where c puts them, as a number for triad.reason; 0: they may.
    p_W = triad.robots(c);
    if triad.least_distance(p_W) < params.separation_min_m
        fault = 11;
    elseif min(p_W(:, 3)) < params.height_min_m
        fault = 12;
    else
        fault = 0;
    end
end
