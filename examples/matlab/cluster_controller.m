function cluster_controller(host, varargin)
    % CLUSTER_CONTROLLER Fly the paper's formation from MATLAB or Octave, in lockstep, instead of zsim's own controller.
    %
    %   zsim gateway
    %   zsim run examples/matlab/step_matlab.yaml
    %   >> cluster_controller                           on this machine, or
    %   >> cluster_controller('10.0.0.5', 'Token', 'secret')
    %
    % At each gate the controller reads the estimates and states of the three drones, and answers with their velocity
    % commands and with cluster/main/state, so that recorder, report and console treat it like zsim's own. The
    % mathematics is in cluster_step.m and +triad. The drones take off at 20 s and fly to the formation of equation (3)
    % of the paper.
    here = fileparts(mfilename('fullpath'));
    addpath(here, fullfile(here, '..', '..', 'clients', 'matlab'));
    if nargin < 1
        host = '127.0.0.1';
    end
    c = zsim.Client(host, varargin{:});
    drones = c.run.clusters(1).drones;
    reads = [strcat('drone/', drones, '/estimate'), strcat('drone/', drones, '/sensor/status')];
    c.join('matlab.main', c.run.gate_s, reads);
    fprintf('%s: flies %s of run %s\n', c.name, strjoin(drones, ', '), c.run.run_id);
    fly(c, drones, target_of_the_paper(), triad.params());
    fprintf('%s: %s\n', c.name, c.left);
    c.close();
end

function target = target_of_the_paper()
    % TARGET_OF_THE_PAPER Return the plan, with c_des of equation (3) as the target.
    %
    % The variables are x_c y_c z_c [m], roll pitch yaw phi_1 phi_2 phi_3 [rad], p q [m], beta [rad].
    target = struct('takeoff_s', 20, 'land_s', inf, 'over_s', nan, ...
        'values', [5; -5; 15; 0; 0; pi / 2; 0; 0; 0; 4; 4; pi / 4]);
end

function fly(c, drones, target, params)
    state = triad.start();
    estimates = unknown();
    shown = -1;
    gate = c.step();
    while ~isempty(gate)
        estimates = take_in(estimates, gate, drones);
        [velocities, yaw_rates, state] = cluster_step(state, estimates, target, params);
        say(c, drones, state, velocities, yaw_rates, estimates.yaw);
        if state.phase ~= shown
            shown = state.phase;
            fprintf('%8.2f s  %s\n', gate.t_s, triad.phase_name(shown));
        end
        gate = c.step();
    end
end

function estimates = unknown()
    % UNKNOWN Return the estimates before the first gate.
    none = nan(3, 3);
    estimates = struct('t_s', 0, 'p_W', none, 'v_W', none, 'yaw', nan(3, 1), 'sigma_m', none, ...
        'age_s', inf(3, 1), 'modes', ones(3, 1), 'stamp_s', -inf(3, 1));
end

function estimates = take_in(estimates, gate, drones)
    % TAKE_IN Store the messages of a gate, in the order of the drones.
    modes = {'landed', 'taking_off', 'hovering', 'flying', 'landing', 'emergency'};
    for i = 1:3
        e = zsim.heard(gate, ['drone/' drones{i} '/estimate']);
        if ~isempty(e)
            estimates.p_W(i, :) = e.position_m;
            estimates.v_W(i, :) = e.velocity_m_s;
            estimates.yaw(i) = e.yaw_rad;
            estimates.sigma_m(i, :) = sqrt(e.covariance([1 8 15]));  % of the position; covariance is 6 x 6, row by row
            estimates.stamp_s(i) = e.t_ns * 1e-9;
        end
        status = zsim.heard(gate, ['drone/' drones{i} '/sensor/status']);
        if ~isempty(status)
            estimates.modes(i) = find(strcmp(status.state, modes));
        end
    end
    estimates.t_s = gate.t_s;
    estimates.age_s = gate.t_s - estimates.stamp_s;
end

function say(c, drones, state, velocities, yaw_rates, yaw)
    % SAY Send the commands of a gate and the cluster's state.
    %
    % Velocities are converted to the heading frame with the estimated yaw.
    modes = {'takeoff', 'land'};
    for i = 1:3
        if state.modes(i)
            c.mode(modes{state.modes(i)}, drones{i});
        end
    end
    for i = find(state.commanded).'
        [s_yaw, c_yaw] = deal(sin(yaw(i)), cos(yaw(i)));
        v_W = velocities(i, :);
        level = [c_yaw * v_W(1) + s_yaw * v_W(2), -s_yaw * v_W(1) + c_yaw * v_W(2)];
        c.velocity(drones{i}, [level, v_W(3)], yaw_rates(i));
    end
    names = {'x_c', 'y_c', 'z_c', 'roll', 'pitch', 'yaw', 'phi_1', 'phi_2', 'phi_3', 'p', 'q', 'beta'};
    reason = triad.reason(max(state.reason, state.note));
    c.put('cluster/main/state', struct('phase', triad.phase_name(state.phase), 'drones', {drones}, ...
        'names', {names}, 'value', state.value.', 'desired', state.desired.', ...
        'desired_rate', state.desired_rate.', 'trajectory_t_s', nan, 'margin', state.margin, 'reason', reason));
end
