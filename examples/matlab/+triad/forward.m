function [c, sound] = forward(p_W, yaw)
    % FORWARD Return the cluster variables of three robots.
    %
    %   p_W    3 x 3, one robot per row [m];  yaw  3 x 1 [rad]
    %   c      12 x 1: x_c y_c z_c [m], roll pitch yaw phi_1 phi_2 phi_3 [rad], p q [m], beta [rad]
    %   sound  whether the robots have a frame; if not, c is zero
    %
    % The frame C has its origin at the centroid, x from the midpoint of robots 2 and 3 to robot 1, and z along d2 x d3;
    % robot 2 is on the left. Robots that are in line or at one point have no frame.
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
