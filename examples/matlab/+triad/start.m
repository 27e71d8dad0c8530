function state = start()
    % START Return the state of cluster_step before its first gate; the sizes of its fields never change.
    none = zeros(12, 1);
    state = struct( ...
        'phase', 0, ...          % 0 idle, 1 taking off, 2 assembling, 3 engaged, 4 landing, 5 held
        'engaged', false, ...    % also in phase 5
        't_s', -1, ...           % time of the last gate; -1 before the first
        'value', none, ...       % cluster variables of the newest estimates that had a frame
        'framed', false, ...     % whether the estimates of this gate have one
        'spread', 0, ...         % sin(beta) min(p, q) [m]
        'margin', 0, ...         % distance to singularity [m]
        'desired', none, ...     % reference, with wrapped angles
        'desired_rate', none, ...
        'integral', none, ...    % of the law [m/s, rad/s]
        'goal', none, ...        % last target; a new one that sets only some variables keeps the rest of it
        'aim', nan(12, 1), ...   % last target.values that were granted
        'ramp', triad.rest(none), ...
        'sound', nan(12, 1), ... % last reference that was found valid
        'fault', 0, ...          % why an engaged formation is held; 0 if it is not; see triad.reason
        'well_since_s', inf, ...
        'plan', 0, ...           % number of completed steps: take-off, engagement, target, landing
        'try_s', -inf, ...       % time of the next attempt at a refused step of the plan
        'note', 0, ...           % why the plan waits
        'reason', 0, ...         % why the phase waits, or the formation is held
        'landing_s', -inf, ...
        'sent_s', -inf(3, 1), ...  % time of the last mode command to each drone
        'modes', zeros(3, 1), ...  % mode commands to send now: 0 none, 1 takeoff, 2 land
        'commanded', false(3, 1), ...  % drones to which a velocity is sent
        'factor', 1, ...         % common factor of the saturation; 1 if nothing is saturated
        'guarded', false, ...    % whether the guard changes the command
        'alarmed', false);       % whether two robots are closer than the alarm threshold
end
