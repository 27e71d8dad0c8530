function cut = split_beta(p, q, beta)
    % SPLIT_BETA Return [cos a2, sin a2, cos a3, sin a3, h] of a triangle, with h = |d2 + d3| [m].
    %
    % a2 and a3 are the angles at robot 1 from -x_C to robots 2 and 3. If x_C does not exist, all values are zero.
    LENGTH_MIN_M = 1e-9;  % a nanometre: below this length, a direction is rounding noise
    along2 = p + q * cos(beta);
    along3 = q + p * cos(beta);
    h = sqrt(max(p * along2 + q * along3, 0));
    if h > LENGTH_MIN_M
        cut = [along2 / h, q * sin(beta) / h, along3 / h, p * sin(beta) / h, h];
    else
        cut = zeros(1, 5);
    end
end
