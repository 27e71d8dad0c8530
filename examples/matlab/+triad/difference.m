function d = difference(c_to, c_from)
    % DIFFERENCE Return c_to - c_from of cluster variables (12 x 1), with wrapped angles; pitch and beta do not wrap.
    d = c_to - c_from;
    wraps = [4 6 7 8 9];  % roll, yaw, phi_1, phi_2, phi_3
    d(wraps) = triad.wrap(d(wraps));
end
