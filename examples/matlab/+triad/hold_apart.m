function [r_dot, guarded] = hold_apart(r_dot, p_W, v_W, separation_min_m, params)
    % HOLD_APART Remove dangerous approaches from the robots' velocities.
    %
    % The rate of the distance d of two robots is limited to d' >= -(d_near - separation_min) / guard_horizon, so the
    % distance predicted over the horizon stays above the minimum, and below the minimum the robots separate. d_near
    % accounts for the present velocities, which persist for the response time. Each robot of a pair takes half of the
    % change.
    %
    %   r_dot    12 x 1, robot by robot [m/s, rad/s];  p_W, v_W  3 x 3, one robot per row, estimates
    %   guarded  whether there were dangerous approaches
    SWEEPS = 4;  % one sweep suffices for two robots; three close to each other need a few
    NEAR_M = 1e-6;  % closer robots have no direction from one to the other: they separate eastwards
    SETTLED_M_S = 1e-9;  % a rate that is short by less counts as reached
    FROM = [1 1 2];
    TO = [2 3 3];
    lines = p_W(TO, :) - p_W(FROM, :);
    distance = sqrt(sum(lines .^ 2, 2));
    u_W = lines ./ (max(distance, NEAR_M) * [1 1 1]);
    u_W(distance < NEAR_M, :) = [ones(sum(distance < NEAR_M), 1), zeros(sum(distance < NEAR_M), 2)];
    fastest = 2 * sqrt(params.speed_max_m_s ^ 2 + params.climb_max_m_s ^ 2);
    within = distance < separation_min_m + fastest * (params.guard_horizon_s + params.response_s);
    near = distance + min(sum(u_W .* (v_W(TO, :) - v_W(FROM, :)), 2), 0) * params.response_s;
    least = (separation_min_m - near) / params.guard_horizon_s;
    v_cmd = reshape(r_dot, 4, 3).';
    guarded = false;
    for sweep = 1:SWEEPS
        settled = true;
        for k = 1:3
            lacking = least(k) - u_W(k, :) * (v_cmd(TO(k), 1:3) - v_cmd(FROM(k), 1:3)).';
            if within(k) && lacking > SETTLED_M_S
                v_cmd(FROM(k), 1:3) = v_cmd(FROM(k), 1:3) - u_W(k, :) * lacking / 2;
                v_cmd(TO(k), 1:3) = v_cmd(TO(k), 1:3) + u_W(k, :) * lacking / 2;
                settled = false;
            end
        end
        guarded = guarded || ~settled;
        if settled
            break
        end
    end
    r_dot = reshape(v_cmd.', 12, 1);
end
