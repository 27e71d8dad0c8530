function state = start()
    % Return the state of cluster_step before its first gate; all its fields keep their sizes.
    none = zeros(12, 1);
    state = struct( ...
        'phase', 0, ...          % 0 idle, 1 taking off, 2 assembling, 3 engaged, 4 landing, 5 held
        'engaged', false, ...    % in phase 5 too
        't_s', -1, ...           % of the last gate, -1 before any
        'value', none, ...       % cluster variables of the newest estimates that had a frame
        'framed', false, ...     % whether the estimates of this gate have one
        'spread', 0, ...         % sin(beta) min(p, q) [m]
        'margin', 0, ...         % distance to singularity [m]
        'desired', none, ...     % reference, angles wrapped
        'desired_rate', none, ...
        'integral', none, ...    % of the law [m/s, rad/s]
        'goal', none, ...        % what a target that names only some variables keeps of the others
        'aim', nan(12, 1), ...   % target.values that were granted last
        'ramp', triad.rest(none), ...
        'sound', nan(12, 1), ... % reference that may be flown, seen at the last gate
        'fault', 0, ...          % why an engaged formation is held, 0 where it is not; see triad.reason
        'well_since_s', inf, ...
        'plan', 0, ...           % steps done: take-off, engagement, target, landing
        'try_s', -inf, ...       % when a step of the plan that was refused is tried again
        'note', 0, ...           % why the plan waits
        'reason', 0, ...         % why the phase waits, or is held
        'landing_s', -inf, ...
        'sent_s', -inf(3, 1), ...  % when each drone was sent a mode command
        'modes', zeros(3, 1), ...  % to send now: 0 none, 1 takeoff, 2 land
        'commanded', false(3, 1), ...  % which drones are to be sent their velocity
        'factor', 1, ...         % common factor of the saturation, 1 where nothing is saturated
        'guarded', false, ...    % whether the guard parts robots
        'alarmed', false);       % whether two robots are nearer than the alarm threshold
end
