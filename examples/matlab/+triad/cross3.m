function c = cross3(a, b)
    % CROSS3 Return a x b of two 3 x 1 vectors, ten times faster than cross.
    c = [a(2) * b(3) - a(3) * b(2); a(3) * b(1) - a(1) * b(3); a(1) * b(2) - a(2) * b(1)];
end
