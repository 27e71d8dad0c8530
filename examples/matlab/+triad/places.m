function [place_C, sound, cut] = places(p, q, beta)
    % PLACES Return the positions of the robots in the cluster frame.
    %
    %   place_C  3 x 3, one robot per column [m];  sound  whether the x axis of the frame exists
    %   cut      as triad.split_beta returns it
    cut = triad.split_beta(p, q, beta);
    sound = cut(5) > 0;
    from_1 = [[0; 0; 0], [-p * cut(1); p * cut(2); 0], [-q * cut(3); -q * cut(4); 0]];
    centre = sum(from_1, 2) / 3;
    place_C = from_1 - [centre centre centre];
end
