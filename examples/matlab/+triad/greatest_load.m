function most = greatest_load(r_dot, params)
    % GREATEST_LOAD Return the largest ratio of a robot's horizontal speed, climb rate or yaw rate to its limit.
    %
    %   r_dot  12 x 1, robot by robot
    level = max(sqrt(r_dot(1:4:9) .^ 2 + r_dot(2:4:10) .^ 2)) / params.speed_max_m_s;
    climb = max(abs(r_dot(3:4:11))) / params.climb_max_m_s;
    turn = max(abs(r_dot(4:4:12))) / params.yaw_rate_max_rad_s;
    most = max([level, climb, turn]);
end
