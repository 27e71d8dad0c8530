function R_WC = rotation(roll, pitch, yaw)
    % ROTATION Return R_WC = Rz(yaw) Ry(pitch) Rx(roll).
    sr = sin(roll);
    cr = cos(roll);
    sp = sin(pitch);
    cp = cos(pitch);
    sy = sin(yaw);
    cy = cos(yaw);
    R_WC = [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
            sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
            -sp,     cp * sr,                cp * cr];
end
