function [velocities, yaw_rates, state] = cluster_step(state, estimates, target, params)
    % CLUSTER_STEP Advance the formation controller of the paper by one gate, from estimates to velocity commands.
    %
    %   state = triad.start();  params = triad.params();
    %   [velocities, yaw_rates, state] = cluster_step(state, estimates, target, params);
    %
    % The function performs no I/O, has no memory except `state`, and all sizes are fixed. It can be called from a
    % MATLAB Function block, with `state` fed back through a unit delay.
    %
    %   estimates.t_s       simulated time [s]
    %   estimates.p_W, v_W  3 x 3, one robot per row [m, m/s; W];  estimates.yaw  3 x 1 [rad]
    %   estimates.sigma_m   3 x 3, standard deviations of the positions;  estimates.age_s  3 x 1 [s]
    %   estimates.modes     3 x 1: 1 landed, 2 taking_off, 3 hovering, 4 flying, 5 landing, 6 emergency
    %   target.takeoff_s    time to take off, assemble and engage [s];  target.land_s  time to land [s]; inf: never
    %   target.values       12 x 1, target of the engaged formation; NaN: the last target's value or, before the first
    %                       one, the value at engagement, except 0 for roll, pitch and phi_1 to phi_3
    %   target.over_s       duration [s]; NaN: as fast as the limits allow. A target may change at any gate
    %
    %   velocities  3 x 3 [m/s, W];  yaw_rates  3 x 1 [rad/s]; for the drones selected by state.commanded
    %   state.modes  3 x 1, mode commands to send: 0 none, 1 takeoff, 2 land
    %   state.phase, .value, .desired, .desired_rate, .margin, .reason  for cluster/NAME/state
    %
    % Mas, Curi, Sanchez Pena, equations (1) to (3); phases, limits and reference are those of zsim's own controller.
    dt_s = 0;
    if state.t_s >= 0
        dt_s = min(max(estimates.t_s - state.t_s, 0), 0.1);  % longest step of the integral, after a gap
    end
    state.t_s = estimates.t_s;
    state.modes = zeros(3, 1);
    state.factor = 1;
    state.guarded = false;
    state.reason = 0;
    state = observe(state, estimates);
    state = run_plan(state, estimates, target, params);
    if (state.phase == 2 || state.engaged) && all(is_down(estimates.modes))
        state.phase = 0;
        state.engaged = false;
    end
    r_dot = zeros(12, 1);
    state.desired = state.value;
    state.desired_rate = zeros(12, 1);
    if state.engaged
        [r_dot, state] = engaged(state, estimates, dt_s, params);
    elseif state.phase == 1
        [r_dot, state] = taking_off(state, estimates, params);
    elseif state.phase == 2
        [r_dot, state] = assembling(state, estimates, params);
    elseif state.phase == 4
        state = landing(state, estimates, params);
    end
    state.commanded = is_airborne(estimates.modes) & any(state.phase == [1 2 3 5]);
    state.alarmed = triad.least_distance(estimates.p_W) < params.separation_alarm_m;
    table = reshape(r_dot, 4, 3).';
    velocities = table(:, 1:3);
    yaw_rates = table(:, 4);
end

% Checks of the estimates

function state = observe(state, estimates)
    state.margin = 0;
    state.framed = false;
    if ~all(is_near([estimates.p_W, estimates.yaw]))
        return
    end
    [c, sound] = triad.forward(estimates.p_W, estimates.yaw);
    if sound
        state.value = c;
        state.framed = true;
        state.spread = triad.spread(c);
        state.margin = state.spread * cos(c(5));
    end
end

function near = is_near(table)
    near = all(abs(table) < 1e6, 2);  % m, m/s or rad: larger values are considered invalid; false for NaN
end

function down = is_down(modes)
    down = modes == 1 | modes == 6;
end

function airborne = is_airborne(modes)
    airborne = modes == 3 | modes == 4;
end

function fault = estimate_fault(estimates, sigma_max_m, params)
    % ESTIMATE_FAULT Return the fault of the first invalid estimate as a number for triad.reason; 0 if there is none.
    fault = 0;
    fit = is_near([estimates.p_W, estimates.v_W, estimates.yaw]);
    for i = 1:3
        if ~(estimates.age_s(i) <= params.age_max_s)
            fault = 2;
        elseif ~fit(i)
            fault = 3;
        elseif ~all(estimates.sigma_m(i, :) <= sigma_max_m)
            fault = 4;
        end
        if fault
            return
        end
    end
end

function fault = formation_fault(state, estimates, params)
    % FORMATION_FAULT Return why the robots' positions are not a valid initial formation; 0 if they are.
    fault = 5;
    if ~state.framed
        return
    end
    fault = triad.shape_fault(state.value, params.spread_min_m, params.tilt_max_rad, params.condition_max);
    if fault == 0 && triad.least_distance(estimates.p_W) < params.separation_min_m
        fault = 11;
    end
end

function fault = take_off_fault(state, estimates, params)
    landed = estimates.modes == 1;
    fault = 1;
    if all(is_airborne(estimates.modes) | landed)
        fault = estimate_fault(estimates, params.sigma_max_m, params);
    end
    if fault == 0 && any(landed)
        fault = formation_fault(state, estimates, params);
    end
end

function fault = engagement_fault(state, estimates, params)
    fault = 1;
    if all(is_airborne(estimates.modes))
        fault = estimate_fault(estimates, params.sigma_max_m, params);
    end
    if fault == 0 && min(estimates.p_W(:, 3)) < params.assembly_height_m - params.assembly_within_m
        fault = 6;
    elseif fault == 0
        fault = formation_fault(state, estimates, params);
    end
end

function fault = flight_fault(state, estimates, params)
    % FLIGHT_FAULT Return why an engaged formation cannot be controlled; the limits are wider than at engagement.
    fault = 1;
    if all(is_airborne(estimates.modes))
        fault = estimate_fault(estimates, params.sigma_lost_m, params);
    end
    if fault == 0 && ~state.framed
        fault = 5;
    elseif fault == 0
        slack = params.flight_slack;
        fault = triad.shape_fault(state.value, params.spread_min_m / slack, params.tilt_max_rad * slack, inf);
    end
end

% The plan: take-off, engagement, target and landing, each as soon as it is due and possible

function state = run_plan(state, estimates, target, params)
    if estimates.t_s >= target.land_s && state.plan < 3
        [state.plan, state.try_s, state.note] = deal(3, -inf, 0);
    end
    apart = state.aim ~= target.values & ~(isnan(state.aim) & isnan(target.values));
    aimed = state.plan == 3 && state.engaged && any(apart);
    due_s = [target.takeoff_s, target.takeoff_s, target.takeoff_s, target.land_s, inf];
    while (estimates.t_s >= due_s(state.plan + 1) || aimed) && estimates.t_s >= state.try_s
        step = state.plan;
        if aimed && estimates.t_s < target.land_s
            step = 2;
        end
        [state, fault] = grant(state, step, estimates, target, params);
        state.note = fault;
        if fault
            state.try_s = estimates.t_s + params.retry_s;
            return
        end
        state.plan = max(state.plan, step + 1);
        state.try_s = -inf;
        aimed = false;
    end
end

function [state, fault] = grant(state, step, estimates, target, params)
    switch step
        case 0
            [state, fault] = grant_take_off(state, estimates, params);
        case 1
            [state, fault] = grant_engagement(state, estimates, params);
        case 2
            [state, fault] = grant_target(state, estimates, target, params);
        otherwise
            fault = 0;
            if state.phase == 0 && all(is_down(estimates.modes))
                fault = 14;
            else
                [state.phase, state.engaged, state.landing_s] = deal(4, false, estimates.t_s);
                state.sent_s = -inf(3, 1);
            end
    end
end

function [state, fault] = grant_take_off(state, estimates, params)
    fault = 14;
    if state.phase == 0
        fault = take_off_fault(state, estimates, params);
    end
    if fault == 0
        state.phase = 1;
        state.sent_s = -inf(3, 1);
    end
end

function [state, fault] = grant_engagement(state, estimates, params)
    fault = 14;
    if state.phase == 2
        fault = engagement_fault(state, estimates, params);
    end
    if fault == 0
        state.goal = state.value;
        state.goal([4 5 7 8 9]) = 0;  % level, with the robots' headings along the formation's
        state.ramp = triad.rest(state.value);
        state.integral = zeros(12, 1);
        state.fault = 0;
        state.phase = 3;
        state.engaged = true;
    end
end

function [state, fault] = grant_target(state, estimates, target, params)
    fault = 14;
    goal = state.goal;
    named = ~isnan(target.values);
    goal(named) = target.values(named);
    ramp = state.ramp;
    if state.engaged
        fault = state.fault;
        if fault == 0
            [c, c_dot] = triad.ramp_value(state.ramp, estimates.t_s);
            [ramp, fault] = triad.plan_ramp(c, c_dot, goal, estimates.t_s, target.over_s, params);
        end
    end
    if fault == 0
        state.ramp = ramp;
        state.goal = goal;
        state.aim = target.values;
    end
end

% The phases

function [r_dot, state] = taking_off(state, estimates, params)
    if all(is_airborne(estimates.modes))
        state.phase = 2;
        [r_dot, state] = assembling(state, estimates, params);
        return
    end
    state = send(state, estimates.modes == 1, 1, params);
    [r_dot, state] = climb(state, estimates, params);
    state.reason = 1;
end

function [r_dot, state] = assembling(state, estimates, params)
    [r_dot, state] = climb(state, estimates, params);
    state.reason = engagement_fault(state, estimates, params);
end

function [r_dot, state] = climb(state, estimates, params)
    % CLIMB Command the drones straight up to the assembly height.
    CLIMB_GAIN_1_S = 0.8;
    r_dot = zeros(12, 1);
    if estimate_fault(estimates, params.sigma_lost_m, params)
        return
    end
    below_m = params.assembly_height_m - estimates.p_W(:, 3);
    r_dot(3:4:11) = min(max(CLIMB_GAIN_1_S * below_m, 0), params.assembly_climb_m_s);
    [r_dot, state.guarded] = triad.hold_apart(r_dot, estimates.p_W, estimates.v_W, params.separation_min_m, params);
end

function [r_dot, state] = engaged(state, estimates, dt_s, params)
    state = judge(state, estimates, params);
    if state.fault
        state.phase = 5;
        state.reason = state.fault;
        r_dot = held(estimates, params);
        return
    end
    state.phase = 3;
    [c_des, c_dot_des] = triad.ramp_value(state.ramp, state.t_s);
    [v_W, yaw_rate, state.integral, state.factor, state.guarded] = triad.law( ...
        state.value, estimates.p_W, estimates.v_W, c_des, c_dot_des, state.integral, dt_s, params);
    r_dot = reshape([v_W, yaw_rate].', 12, 1);
    state.desired = triad.difference(c_des, zeros(12, 1));
    state.desired_rate = c_dot_des;
end

function r_dot = held(estimates, params)
    HOLD_APART_M = 0.1;  % additional separation of a held formation
    r_dot = zeros(12, 1);
    if estimate_fault(estimates, params.sigma_lost_m, params) == 0
        apart_m = params.separation_min_m + HOLD_APART_M;
        r_dot = triad.hold_apart(r_dot, estimates.p_W, estimates.v_W, apart_m, params);
    end
end

function state = judge(state, estimates, params)
    % JUDGE Set the fault of an engaged formation; when there has been none for a while, let the formation continue.
    fault = flight_fault(state, estimates, params);
    if fault == 0 && state.fault == 0
        c_des = triad.ramp_value(state.ramp, state.t_s);
        if any(c_des ~= state.sound)  % a reference at rest is checked only once
            fault = triad.place_fault(c_des, params);
            state.sound = c_des;
        end
        if fault
            state.sound = nan(12, 1);
        end
    end
    if fault
        state.fault = fault;
        state.well_since_s = inf;
    elseif state.fault
        state.well_since_s = min(state.well_since_s, state.t_s);
        if state.t_s - state.well_since_s >= params.heal_s
            state = heal(state, params);
        end
    end
end

function state = heal(state, params)
    % HEAL Continue from the present formation, at rest; the path back observes the limits for flight.
    wide = params;
    wide.spread_min_m = params.spread_min_m / params.flight_slack;
    wide.tilt_max_rad = params.tilt_max_rad * params.flight_slack;
    wide.condition_max = inf;
    [ramp, fault] = triad.plan_ramp(state.value, zeros(12, 1), state.ramp.goal, state.t_s, nan, wide);
    state.fault = fault;
    state.well_since_s = state.t_s;
    if fault == 0
        state.ramp = ramp;
        state.integral = zeros(12, 1);
        state.well_since_s = inf;
    end
end

function state = landing(state, estimates, params)
    state = send(state, is_airborne(estimates.modes) | estimates.modes == 2, 2, params);
    % A take-off command may still be in transit, so the phase is idle only some time after the landing request.
    if all(is_down(estimates.modes)) && state.t_s - state.landing_s >= params.resend_s
        state.phase = 0;
    end
end

function state = send(state, wanted, mode, params)
    % SEND Send a mode command to the selected drones; repeat it if it has had no effect after a while.
    due = wanted & state.t_s - state.sent_s >= params.resend_s;
    state.sent_s(due) = state.t_s;
    state.modes(due) = mode;
end
