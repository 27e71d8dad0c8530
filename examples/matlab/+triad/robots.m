function [p_W, yaw, sound] = robots(c)
    % ROBOTS Return the positions and headings of the robots from cluster variables.
    %
    %   c      12 x 1, as returned by triad.forward
    %   p_W    3 x 3, one robot per row [m];  yaw  3 x 1 [rad, wrapped]
    %   sound  whether the shape has an extent
    [place_C, sound] = triad.places(c(10), c(11), c(12));
    p_W = (triad.rotation(c(4), c(5), c(6)) * place_C + c(1:3) * ones(1, 3)).';
    yaw = triad.wrap(c(6) + c(7:9));
end
