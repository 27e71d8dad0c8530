function p = params()
    % PARAMS Return the gains and limits of the formation, which are the defaults of `gains` in a scenario.
    p = struct( ...
        'k_1_s', 0.6, ...                     % proportional gain; unstable from about 2 on with a drone's velocity loop
        'integral_1_s2', 0.05, ...            % removes the offset due to steady wind within half a minute
        'integral_max_m_s', 0.5, ...          % limit of the integral term for lengths
        'integral_max_rad_s', 0.1, ...        % and for angles
        'speed_max_m_s', 1.5, ...             % horizontal speed of each robot: a third of the firmware's limit
        'climb_max_m_s', 0.8, ...             % the firmware's limit is 1 m/s
        'yaw_rate_max_rad_s', 60 * pi / 180, ...
        'separation_min_m', 2.0, ...          % minimum distance of two robots, for references and for the guard
        'separation_alarm_m', 1.5, ...
        'guard_horizon_s', 1.0, ...           % how far ahead the guard looks
        'response_s', 0.3, ...                % lag of a drone's velocity loop
        'share', 0.8, ...                     % part of the limits above that references may use; the law has the rest
        'spread_min_m', 1.0, ...              % minimum of sin(beta) min(p, q) to engage, and of a target
        'tilt_max_rad', 30 * pi / 180, ...    % maximum roll and pitch of the formation
        'condition_max', 20.0, ...            % maximum condition number of J^-1
        'height_min_m', 0.5, ...              % minimum height of a robot's reference
        'flight_slack', 1.5, ...              % factor by which the limits of the shape are wider in flight
        'assembly_height_m', 1.5, ...         % height to which drones climb straight up before engagement
        'assembly_within_m', 0.3, ...
        'assembly_climb_m_s', 0.5, ...
        'age_max_s', 0.5, ...                 % maximum age of an estimate that is used
        'sigma_max_m', 1.0, ...               % maximum sigma of a position to take off and to engage
        'sigma_lost_m', 2.0, ...              % and in flight
        'heal_s', 0.5, ...                    % time without faults after which a held formation continues
        'resend_s', 1.0, ...                  % time after which a mode command without effect is repeated
        'retry_s', 0.5);                      % between two attempts at a refused step of the plan
end
