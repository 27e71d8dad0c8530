function [ramp, fault] = plan_ramp(c, c_dot, goal, t_s, over_s, params)
    % PLAN_RAMP Return the ramp from c, moving at c_dot, to a goal (12 x 1 each).
    %
    %   over_s  duration [s]; NaN: as fast as the limits allow
    %   fault   why the ramp must not be flown, as a number for triad.reason; 0: it may
    %
    % The goal and the path are checked for shape, distances, heights, and the robots' speeds.
    RAMP_MIN_S = 2;
    RAMP_MAX_S = 3600;
    TOLERANCE = 1.02;  % factor of the share: ramps are sampled, and may start at the limit
    ramp = triad.rest(goal);
    ramp.start_s = t_s;
    ramp.offset = triad.difference(c, goal);
    ramp.offset_rate = c_dot;
    fault = fault_at(goal, zeros(12, 1), params, TOLERANCE);
    if fault
        return
    end
    ramp.over_s = RAMP_MIN_S;
    excess = peak_load(ramp, params) / params.share;
    while excess > TOLERANCE
        ramp.over_s = ramp.over_s * max(min(excess, 10), 1.2);  % 1.2: smallest step of the search
        if ~(ramp.over_s <= RAMP_MAX_S)
            fault = 13;
            return
        end
        excess = peak_load(ramp, params) / params.share;
    end
    if ~isnan(over_s)
        ramp.over_s = over_s;
        if ~(over_s > 0 && over_s <= RAMP_MAX_S && peak_load(ramp, params) <= params.share * TOLERANCE)
            fault = 13;
            return
        end
    end
    fault = way_fault(ramp, params, TOLERANCE);
end

function fault = way_fault(ramp, params, tolerance)
    % WAY_FAULT Return why the path must not be flown, from 41 to 301 samples; 0: it may.
    SAMPLE_S = 0.5;  % at 2 m/s a robot moves 1 m between two samples
    count = min(max(ceil(ramp.over_s / SAMPLE_S) + 1, 41), 301);
    times_s = linspace(ramp.start_s, ramp.start_s + ramp.over_s, count);
    fault = 0;
    for k = 1:count
        [c, c_dot] = triad.ramp_value(ramp, times_s(k));
        fault = fault_at(c, c_dot, params, tolerance);
        if fault
            return
        end
    end
end

function fault = fault_at(c, c_dot, params, tolerance)
    fault = triad.shape_fault(c, params.spread_min_m, params.tilt_max_rad, params.condition_max);
    if fault
        return
    end
    fault = triad.place_fault(c, params);
    if fault == 0 && triad.greatest_load(triad.inverse_jacobian(c) * c_dot, params) > params.share * tolerance
        fault = 13;
    end
end

function most = peak_load(ramp, params)
    SAMPLES = 33;  % odd, so that one is at the middle of the ramp, where its rate is highest
    times_s = linspace(ramp.start_s, ramp.start_s + ramp.over_s, SAMPLES);
    most = 0;
    for k = 1:SAMPLES
        [c, c_dot] = triad.ramp_value(ramp, times_s(k));
        most = max(most, triad.greatest_load(triad.inverse_jacobian(c) * c_dot, params));
    end
end
