function fault = shape_fault(c, spread_min_m, tilt_max_rad, condition_max)
    % SHAPE_FAULT Return why c (12 x 1) is not a valid formation, as a number for triad.reason; 0: it is.
    FAR = 1e6;  % m or rad: larger values are considered invalid
    inside = all(abs(c) < FAR) && abs(c(5)) < pi / 2 && c(10) > 0 && c(11) > 0 && c(12) > 0 && c(12) < pi;
    if ~inside
        fault = 7;
    elseif ~(triad.spread(c) > spread_min_m)
        fault = 8;
    elseif ~(max(abs(c(4:5))) < tilt_max_rad)
        fault = 9;
    elseif isfinite(condition_max) && ~(triad.condition(c) < condition_max)
        fault = 10;
    else
        fault = 0;
    end
end
