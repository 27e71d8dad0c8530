function [R_WC, h, area, sound] = axes(d2, d3)
    % Return the axes of the cluster frame in W as columns, h = |d2 + d3| [m], |d2 x d3| [m^2], and whether there
    % are any.
    %
    %   d2, d3  3 x 1, from robot 1 to robots 2 and 3, in W [m]
    LENGTH_MIN_M = 1e-9;  % a nanometre: below it a direction is rounding noise
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
