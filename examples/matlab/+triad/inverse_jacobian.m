function [J_inv, sound] = inverse_jacobian(c)
    % INVERSE_JACOBIAN Return J^-1 (12 x 12) with r_dot = J^-1 c_dot, in closed form.
    %
    %   r_dot  12 x 1: vx vy vz [m/s, W] and yaw rate [rad/s], robot by robot
    %   sound  whether the shape has an extent
    %
    % Robot i moves at v_c + R_WC (w_WC_C x place_i + the derivatives of place_i with respect to p, q and beta times
    % their rates), and turns at yaw' + phi_i'.
    J_inv = zeros(12, 12);
    [place_C, sound, cut] = triad.places(c(10), c(11), c(12));
    if ~sound
        return
    end
    R_WC = triad.rotation(c(4), c(5), c(6));
    axes_C = euler_axes(c(4), c(5));
    shape_C = shape_rates(c(10), c(11), cut);
    for i = 1:3
        turn_C = -skew(place_C(:, i)) * axes_C;
        rows = 4 * i - 3:4 * i - 1;
        J_inv(rows, 1:3) = eye(3);
        J_inv(rows, 4:6) = R_WC * turn_C;
        J_inv(rows, 10:12) = R_WC * shape_C(:, 3 * i - 2:3 * i);
        J_inv(4 * i, 6) = 1;
        J_inv(4 * i, 6 + i) = 1;
    end
end

function axes_C = euler_axes(roll, pitch)
    % EULER_AXES Return w_WC_C for unit rates of roll, pitch and yaw, as columns.
    axes_C = [1, 0,          -sin(pitch)
              0, cos(roll),  sin(roll) * cos(pitch)
              0, -sin(roll), cos(roll) * cos(pitch)];
end

function S = skew(a)
    % SKEW Return the matrix S with S b = a x b.
    S = [0, -a(3), a(2); a(3), 0, -a(1); -a(2), a(1), 0];
end

function rates_C = shape_rates(p, q, cut)
    % SHAPE_RATES Return the derivatives of the robots' places with respect to p, q and beta, 3 x 9, robot by robot.
    %
    % The centroid does not move.
    ca2 = cut(1);
    sa2 = cut(2);
    ca3 = cut(3);
    sa3 = cut(4);
    h = cut(5);
    by_p = -sa2 / h;  % derivatives of the angle of robot 2; robot 3's has the opposite sense
    by_q = sa3 / h;
    of_2 = [-ca2 + p * sa2 * by_p, p * sa2 * by_q, p * sa2 * q * ca3 / h
            sa2 + p * ca2 * by_p,  p * ca2 * by_q, p * ca2 * q * ca3 / h
            0,                     0,              0];
    of_3 = [-q * sa3 * by_p, -ca3 - q * sa3 * by_q, q * sa3 * p * ca2 / h
            q * ca3 * by_p,  -sa3 + q * ca3 * by_q, -q * ca3 * p * ca2 / h
            0,               0,                     0];
    back = (of_2 + of_3) / 3;
    rates_C = [-back, of_2 - back, of_3 - back];
end
