function angle = wrap(angle)
    % WRAP Return angles [rad] wrapped to [-pi, pi].
    angle = angle - 2 * pi * round(angle / (2 * pi));
end
