function ramp = rest(c)
    % REST Return the reference that rests at c (12 x 1).
    ramp = struct('start_s', 0, 'over_s', 0, 'goal', c, 'offset', zeros(12, 1), 'offset_rate', zeros(12, 1));
end
