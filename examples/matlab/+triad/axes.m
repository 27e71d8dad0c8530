function [R_WC, h, area, sound] = axes(d2, d3)
    % AXES Return the axes of the cluster frame.
    %
    %   d2, d3   3 x 1, from robot 1 to robots 2 and 3, in W [m]
    %   R_WC     axes in W, as columns;  h  |d2 + d3| [m];  area  |d2 x d3| [m^2];  sound  whether the axes exist
    LENGTH_MIN_M = 1e-9;  % a nanometre: below this length, a direction is rounding noise
    R_WC = zeros(3, 3);
    m = d2 + d3;
    normal = triad.cross3(d2, d3);
    h = norm(m);
    area = norm(normal);
    sound = h > LENGTH_MIN_M && area > LENGTH_MIN_M * h;  % false for NaN too
    if sound
        x = -m / h;
        z = normal / area;
        R_WC = [x, triad.cross3(z, x), z];
    end
end
