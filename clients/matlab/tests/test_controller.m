function test_controller()
    % TEST_CONTROLLER Test that cluster_step flies ideal drones to its target, without NaN or a change of size.
    here = fileparts(mfilename('fullpath'));
    addpath(fullfile(here, '..', '..', '..', 'examples', 'matlab'));
    params = triad.params();
    state = triad.start();
    first = state;
    target = struct('takeoff_s', 1, 'land_s', 40, 'over_s', nan, ...
        'values', [5; -5; 8; 0; 0; pi / 2; 0; 0; 0; 4; 4; pi / 4]);
    e = struct('t_s', 0, 'p_W', [0 1.5 0; -1.5 -1.5 0; 1.5 -1.5 0], 'v_W', zeros(3, 3), 'yaw', ones(3, 1) * pi / 2, ...
        'sigma_m', 0.3 * ones(3, 3), 'age_s', zeros(3, 1), 'modes', ones(3, 1));
    dt_s = 0.1;
    phases = [];
    while e.t_s < 42
        [velocities, yaw_rates, state] = cluster_step(state, e, target, params);
        assert(all(isfinite(velocities(:))) && all(isfinite(yaw_rates)));
        assert(isequal(sizes(state), sizes(first)));
        phases = [phases, state.phase]; %#ok<AGROW>
        if abs(e.t_s - 39) < dt_s / 2
            assert(max(abs(triad.difference(state.value, target.values))) < 0.01);
        end
        e = moved(e, state, velocities, yaw_rates, dt_s);
    end
    assert(isequal(phases([true, diff(phases) ~= 0]), [0 1 2 3 4 0]));
end

function found = sizes(state)
    found = structfun(@size, state, 'UniformOutput', false);
end

function e = moved(e, state, velocities, yaw_rates, dt_s)
    e.modes(state.modes == 1) = 3;
    e.modes(state.modes == 2) = 1;
    e.v_W = velocities .* (state.commanded * [1 1 1]);
    e.p_W = e.p_W + dt_s * e.v_W;
    e.yaw = e.yaw + dt_s * yaw_rates .* state.commanded;
    e.t_s = e.t_s + dt_s;
end
