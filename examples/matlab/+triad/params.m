function p = params()
    % Return the gains and limits of the formation: the defaults of a scenario's `gains`, and of our own controller.
    p = struct( ...
        'k_1_s', 0.6, ...                     % proportional gain; unstable from about 2 on a drone's velocity loop
        'integral_1_s2', 0.05, ...            % takes a steady wind's offset away within half a minute
        'integral_max_m_s', 0.5, ...          % clamp of the integral term, of lengths
        'integral_max_rad_s', 0.1, ...        % and of angles
        'speed_max_m_s', 1.5, ...             % of each robot, level: a third of what the firmware allows
        'climb_max_m_s', 0.8, ...             % of the 1 m/s that the firmware allows
        'yaw_rate_max_rad_s', 60 * pi / 180, ...
        'separation_min_m', 2.0, ...          % least distance of two robots of a reference, and where the guard acts
        'separation_alarm_m', 1.5, ...
        'guard_horizon_s', 1.0, ...           % how far ahead the guard looks
        'response_s', 0.3, ...                % lag of a drone's velocity loop
        'share', 0.8, ...                     % of the limits above that a reference may use; the law keeps the rest
        'spread_min_m', 1.0, ...              % least sin(beta) min(p, q) to engage or to lead to
        'tilt_max_rad', 30 * pi / 180, ...    % greatest roll and pitch of the formation
        'condition_max', 20.0, ...            % greatest condition number of J^-1
        'height_min_m', 0.5, ...              % least height of a robot's reference
        'flight_slack', 1.5, ...              % in flight the limits of shape are wider by this
        'assembly_height_m', 1.5, ...         % to which drones climb straight up before engagement
        'assembly_within_m', 0.3, ...
        'assembly_climb_m_s', 0.5, ...
        'age_max_s', 0.5, ...                 % oldest estimate that is flown on
        'sigma_max_m', 1.0, ...               % greatest sigma of a position to take off and to engage
        'sigma_lost_m', 2.0, ...              % in flight
        'heal_s', 0.5, ...                    % how long all must be well before a held formation goes on
        'resend_s', 1.0, ...                  % after it a mode command without effect is sent again
        'retry_s', 0.5);                      % between two tries of a step of the plan that was refused
end
