function [place_C, sound, cut] = places(p, q, beta)
    % Return the places of the robots in the cluster frame, a robot a column (3 x 3) [m], and whether there is an axis.
    %
    %   cut  [cos a2, sin a2, cos a3, sin a3, h]: how -x_C cuts beta, a2 to robot 2 and a3 to robot 3, h = |d2 + d3| [m]
    cut = triad.split_beta(p, q, beta);
    sound = cut(5) > 0;
    from_1 = [[0; 0; 0], [-p * cut(1); p * cut(2); 0], [-q * cut(3); -q * cut(4); 0]];
    centre = sum(from_1, 2) / 3;
    place_C = from_1 - [centre centre centre];
end
