function fault = shape_fault(c, spread_min_m, tilt_max_rad, condition_max)
    % Return why c (12 x 1) is no formation to engage, to lead to or to fly, as a number for triad.reason; 0: it is one.
    FAR = 1e6;  % m or rad: beyond it a value is a slip
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
