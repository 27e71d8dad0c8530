function [r_dot, guarded] = hold_apart(r_dot, p_W, v_W, separation_min_m, params)
    % Return the robots' velocities with dangerous approaches taken out, and whether there were any.
    %
    % Two robots at distance d are held to d' >= -(d_near - separation_min) / guard_horizon: the distance predicted over
    % the horizon stays above the minimum, and below it the approach is reversed. d_near allows for the velocities that
    % the robots have, which last for their response time. Each of a pair takes half of the change.
    %
    %   r_dot  12 x 1, robot by robot [m/s, rad/s];  p_W, v_W  3 x 3, a robot a row, estimates
    SWEEPS = 4;  % one settles two robots, three in a corner need a few
    NEAR_M = 1e-6;  % robots that are nearer have no direction from one to the other: they part eastwards
    SETTLED_M_S = 1e-9;  % a rate that lacks less is reached
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
