function [c, sound] = forward(p_W, yaw)
    % Return the cluster variables of three robots, and whether they have a frame.
    %
    %   p_W    3 x 3, a robot a row [m]; yaw  3 x 1 [rad]
    %   c      12 x 1: x_c y_c z_c [m], roll pitch yaw phi_1 phi_2 phi_3 [rad], p q [m], beta [rad]
    %
    % The frame C has its origin at the centroid, x from the middle of robots 2 and 3 to robot 1, z along d2 x d3;
    % robot 2 is on the left. Robots in line or in one place have none, and c is zero then.
    c = zeros(12, 1);
    d2 = (p_W(2, :) - p_W(1, :)).';
    d3 = (p_W(3, :) - p_W(1, :)).';
    [R_WC, ~, area, sound] = triad.axes(d2, d3);
    if ~sound
        return
    end
    c(1:3) = sum(p_W, 1).' / 3;
    c(4) = atan2(R_WC(3, 2), R_WC(3, 3));
    c(5) = atan2(-R_WC(3, 1), hypot(R_WC(1, 1), R_WC(2, 1)));
    c(6) = atan2(R_WC(2, 1), R_WC(1, 1));
    c(7:9) = triad.wrap(yaw(:) - c(6));
    c(10) = norm(d2);
    c(11) = norm(d3);
    c(12) = atan2(area, d2.' * d3);
end
