function [c, c_dot] = ramp_value(ramp, t_s)
    % RAMP_VALUE Return a reference and its rate (12 x 1 each) at t_s [s]; angles are continuous, not wrapped.
    %
    % c is the goal plus the initial offset, which a quintic takes to zero together with its first and second
    % derivatives; from rest, this is the minimum-jerk motion. After over_s the reference rests at the goal.
    c = ramp.goal;
    c_dot = zeros(12, 1);
    if t_s - ramp.start_s >= ramp.over_s
        return
    end
    s = max((t_s - ramp.start_s) / ramp.over_s, 0);
    left = 1 - s * s * s * (10 - s * (15 - 6 * s));
    left_rate = -30 * s * s * (1 - s) * (1 - s) / ramp.over_s;
    swing = s * (1 - s * s * (6 - s * (8 - 3 * s))) * ramp.over_s;
    swing_rate = 1 - s * s * (18 - s * (32 - 15 * s));
    c = c + left * ramp.offset + swing * ramp.offset_rate;
    c_dot = left_rate * ramp.offset + swing_rate * ramp.offset_rate;
end
