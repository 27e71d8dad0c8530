function angle = wrap(angle)
    % Return angles [rad] taken to [-pi, pi].
    angle = angle - 2 * pi * round(angle / (2 * pi));
end
