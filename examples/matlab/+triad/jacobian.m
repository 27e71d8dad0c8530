function [J, sound] = jacobian(p_W, yaw)  %#ok<INUSD>
    % JACOBIAN Return J (12 x 12) with c_dot = J r_dot.
    %
    %   p_W    3 x 3, one robot per row [m];  yaw  3 x 1 [rad]
    %   r_dot  12 x 1: vx vy vz [m/s, W] and yaw rate [rad/s], robot by robot
    %   sound  whether the robots have a frame and a heading
    J = zeros(12, 12);
    d2 = (p_W(2, :) - p_W(1, :)).';
    d3 = (p_W(3, :) - p_W(1, :)).';
    [R_WC, h, area, sound] = triad.axes(d2, d3);
    if ~sound
        return
    end
    x = R_WC(:, 1);
    y = R_WC(:, 2);
    z = R_WC(:, 3);
    flat = hypot(x(1), x(2));  % cosine of the pitch
    sound = flat > 1e-9;  % at a pitch of 90 deg, roll and yaw are the same rotation
    if ~sound
        return
    end
    J(1:3, [1:3 5:7 9:11]) = [eye(3) eye(3) eye(3)] / 3;
    J(4:6, [1:3 5:7 9:11]) = euler_rates(R_WC, flat) * body_rates(d2.' * x, d3.' * x, y.', z.', h, area);
    for i = 1:3
        J(6 + i, 4 * i) = 1;
        J(6 + i, :) = J(6 + i, :) - J(6, :);
    end
    J(10:12, [1:3 5:7 9:11]) = triangle(d2, d3, z);
end

function rates = body_rates(d2_x, d3_x, y, z, h, area)
    % BODY_RATES Return the matrix (3 x 9) from the velocities of the robots to w_WC_C.
    rates = [(d3_x - d2_x) * z / area, -d3_x * z / area, d2_x * z / area
             -2 * z / h,               z / h,            z / h
             2 * y / h,                -y / h,           -y / h];
end

function T = euler_rates(R_WC, cos_pitch)
    % EULER_RATES Return T (3 x 3) with (roll', pitch', yaw') = T w_WC_C.
    sin_pitch = -R_WC(3, 1);
    roll = atan2(R_WC(3, 2), R_WC(3, 3));
    T = [1, sin(roll) * sin_pitch / cos_pitch, cos(roll) * sin_pitch / cos_pitch
         0, cos(roll),                         -sin(roll)
         0, sin(roll) / cos_pitch,             cos(roll) / cos_pitch];
end

function rows = triangle(d2, d3, z)
    % TRIANGLE Return the rows of J for p, q and beta (3 x 9).
    p = norm(d2);
    q = norm(d3);
    u2 = (d2 / p).';
    u3 = (d3 / q).';
    t2 = triad.cross3(z, u2.').' / p;
    t3 = triad.cross3(z, u3.').' / q;
    none = zeros(1, 3);
    rows = [-u2, u2, none; -u3, none, u3; t2 - t3, -t2, t3];
end
