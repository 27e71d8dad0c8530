function [v_cmd_W, yaw_rate, integral, factor, guarded] = law(c, p_W, v_W, c_des, c_dot_des, integral, dt_s, params)
    % LAW Return the velocity commands of a formation, and the integral term after this gate.
    %
    %   c_dot_cmd = c_dot_des + k (c_des - c) + I,    I' = k_i (c_des - c),    r_dot = J^-1(c) c_dot_cmd
    %
    % The command is then saturated by one factor for all robots, which keeps its direction in cluster space, and
    % corrected by a guard of the distances between robots (triad.hold_apart). The integral is updated only while
    % neither changes the command.
    %
    %   c, c_des, c_dot_des, integral  12 x 1;  p_W, v_W  3 x 3, one robot per row, estimates [m, m/s]
    %   v_cmd_W  3 x 3 [m/s, W];  yaw_rate  3 x 1 [rad/s];  factor  of the saturation
    LOAD_MIN = 1e-9;  % avoids division by zero
    missing = triad.difference(c_des, c);
    c_dot = c_dot_des + params.k_1_s * missing + integral;
    r_dot = triad.inverse_jacobian(c) * c_dot;
    factor = min(1, 1 / max(triad.greatest_load(r_dot, params), LOAD_MIN));
    [r_dot, guarded] = triad.hold_apart(r_dot * factor, p_W, v_W, params.separation_min_m, params);
    if guarded
        r_dot = r_dot / max(triad.greatest_load(r_dot, params), 1);
    elseif factor == 1
        clamp = params.integral_max_m_s * ones(12, 1);
        clamp([4:9 12]) = params.integral_max_rad_s;
        integral = min(max(integral + params.integral_1_s2 * dt_s * missing, -clamp), clamp);
    end
    table = reshape(r_dot, 4, 3).';
    v_cmd_W = table(:, 1:3);
    yaw_rate = table(:, 4);
end
