function cluster_cases(path)
    % CLUSTER_CASES Print the results of triad and cluster_step for the cases in a JSON file.
    %
    %   maps     p_W, yaw and v_W of robots and their rates r_dot, a reference c_des with its rate, integral, dt_s
    %   flights  gates: the estimates at each gate; targets: each target, and from when on it applies
    %
    % tests/unit/clients/test_octave_cluster.py compares them with zsim's results.
    here = fileparts(mfilename('fullpath'));
    addpath(fullfile(here, '..'), fullfile(here, '..', '..', '..', 'examples', 'matlab'));
    cases = jsondecode(fileread(path));
    params = triad.params();
    maps = cell(1, numel(cases.maps));
    for k = 1:numel(maps)
        maps{k} = mapped(cases.maps(k), params);
    end
    flights = cell(1, numel(cases.flights));
    for k = 1:numel(flights)
        flights{k} = flown(cases.flights(k), params);
    end
    disp(zsim.encode(struct('maps', {maps}, 'flights', {flights})));
end

function said = mapped(of, params)
    [c, sound] = triad.forward(of.p_W, of.yaw);
    [p_W, yaw] = triad.robots(c);
    [v_W, yaw_rate, integral, factor] = triad.law( ...
        c, of.p_W, of.v_W, of.c_des, of.c_dot_des, of.integral, of.dt_s, params);
    said = struct('sound', sound, 'c', c, 'p_W', p_W, 'yaw', yaw, 'J', triad.jacobian(of.p_W, of.yaw), ...
        'J_inv', triad.inverse_jacobian(c), 'condition', triad.condition(c), 'v_W', v_W, 'yaw_rate', yaw_rate, ...
        'integral', integral, 'factor', factor);
end

function said = flown(flight, params)
    % FLOWN Step through a recorded flight; JSON's null is NaN here, or [] if a whole table was null.
    state = triad.start();
    said = cell(1, numel(flight.gates));
    for k = 1:numel(said)
        gate = flight.gates(k);
        target = flight.targets(find([flight.targets.from_s] <= gate.t_s, 1, 'last'));
        [v_W, yaw_rate, state] = cluster_step(state, gate, target, params);
        said{k} = struct('v_W', v_W, 'yaw_rate', yaw_rate, 'commanded', state.commanded, 'modes', state.modes, ...
            'phase', triad.phase_name(state.phase), 'value', state.value, 'desired', state.desired, ...
            'desired_rate', state.desired_rate, 'margin', state.margin, 'factor', state.factor);
    end
end
