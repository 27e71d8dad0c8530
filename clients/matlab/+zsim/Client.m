classdef Client < handle
    % CLIENT Client for a running zsim federation, through `zsim gateway`.
    %
    % For MATLAB R2020b or newer and GNU Octave 7 or newer.
    %
    %   c = zsim.Client('127.0.0.1');
    %   c.takeoff('drone1');
    %   e = c.estimate('drone1')                     % the last value; e.position_m is 1 x 3
    %   c.velocity('drone1', [0.5 0 0], 0);          % forward, left, up [m/s]; yaw rate [rad/s]
    %   c.close();
    %
    % In the lockstep, where simulated time waits for this program:
    %
    %   c.join('myctrl', 0.02, {'drone/drone1/estimate'});
    %   gate = c.step();
    %   while ~isempty(gate)                         % [] when the run is over; c.left says why
    %       e = zsim.heard(gate, 'drone/drone1/estimate');
    %       c.velocity('drone1', [0.5 0 0], 0);      % in a gate, it is part of the answer
    %       gate = c.step();                         % answers this gate, waits for the next
    %   end
    %
    % Keys, messages, units and frames are those of docs/protocol.md. Lists of numbers are rows, 1 x n. Times t_ns are
    % doubles, exact up to 2^53 ns (104 days).
    %
    % Errors: zsim:connection (no gateway within Wait, or the connection is lost), zsim:refused (a request was refused,
    % and had no effect), zsim:timeout (no answer), zsim:argument (a value that cannot be sent, or an unknown option).

    properties (SetAccess = private)
        name = ''  % name under which this client sends, e.g. client.laptop
        run = []  % run_id, federation, mode, gate_s, drones (cell of names), clusters (struct array: name, drones)
    end

    properties (Dependent)
        left  % why the last lockstep session ended; '' during a session, or if there was none
        lost  % number of values of subscriptions dropped because they were not taken in time
    end

    properties (Access = private)
        talk  % zsim.Conversation
        timeout_s
        outputs = {}  % messages for the open gate, as JSON
    end

    methods
        function c = Client(host, varargin)
            % CLIENT Connect to a gateway.
            %
            % Options by name and value, with their defaults:
            %   'Port' (7470), 'Token' (the environment variable ZSIM_TOKEN), 'Name' (chosen by the gateway),
            %   'Timeout' (10 s, for an answer), 'Wait' (30 s, for the gateway to start and a run to begin)
            if nargin < 1
                host = '127.0.0.1';
            end
            given = options(varargin);
            c.timeout_s = given.timeout;
            start = tic;
            c.talk = zsim.Conversation(char(host), given.port, given.timeout, given.wait);
            c.greet(given, start);
        end

        function reason = get.left(c), reason = c.talk.left; end
        function count = get.lost(c), count = c.talk.lost; end

        % Last values

        function value = latest(c, key)
            % LATEST Return the last value of a key, or [] if there is none yet.
            %
            % For an expression with *, return a struct array of key and value.
            answer = c.request('latest', ['"key":' text_of(key)]);
            found = zsim.entries(answer.values);
            if any(char(key) == '*')
                value = found;
            elseif isempty(found)
                value = [];
            else
                value = found.value;
            end
        end

        function value = imu(c, drone), value = c.latest(['drone/' char(drone) '/sensor/imu']); end
        function value = gps(c, drone), value = c.latest(['drone/' char(drone) '/sensor/gps']); end
        function value = mag(c, drone), value = c.latest(['drone/' char(drone) '/sensor/mag']); end
        function value = baro(c, drone), value = c.latest(['drone/' char(drone) '/sensor/baro']); end
        function value = sonar(c, drone), value = c.latest(['drone/' char(drone) '/sensor/sonar']); end
        function value = flow(c, drone), value = c.latest(['drone/' char(drone) '/sensor/flow']); end
        function value = status(c, drone), value = c.latest(['drone/' char(drone) '/sensor/status']); end
        function value = truth(c, drone), value = c.latest(['drone/' char(drone) '/truth']); end
        function value = estimate(c, drone), value = c.latest(['drone/' char(drone) '/estimate']); end
        function value = cluster(c, name), value = c.latest(['cluster/' char(name) '/state']); end
        function value = clock(c), value = c.latest('clock'); end

        % Subscriptions

        function subscribe(c, key)
            % SUBSCRIBE Subscribe to a key or expression; `next` returns its values.
            c.request('subscribe', ['"key":' text_of(key)]);
        end

        function unsubscribe(c, key)
            c.request('unsubscribe', ['"key":' text_of(key)]);
        end

        function [value, key] = next(c, timeout_s)
            % NEXT Return the oldest value of the subscriptions that has not been taken, and its key.
            %
            % Both are [] if there is none within timeout_s (default: the option Timeout).
            if nargin < 2
                timeout_s = c.timeout_s;
            end
            [value, key] = c.talk.next(timeout_s);
        end

        % Publications

        function put(c, key, value)
            % PUT Publish a value; t_ns, seq and source can be omitted. In a gate, it is part of the answer.
            c.say(char(key), zsim.encode(value));
        end

        function velocity(c, drone, velocity_m_s, yaw_rate_rad_s, frame)
            % VELOCITY Command a velocity [m/s] and a yaw rate [rad/s].
            %
            % frame is 'heading' (forward, left, up; the default) or 'world'.
            if nargin < 4
                yaw_rate_rad_s = 0;
            end
            if ~isnumeric(velocity_m_s) || numel(velocity_m_s) ~= 3
                error('zsim:argument', 'velocity has %d numbers; must have 3: x, y, z', numel(velocity_m_s));
            end
            numbers = double([velocity_m_s(:).' yaw_rate_rad_s]);
            if ~all(isfinite(numbers))
                error('zsim:argument', 'velocity or yaw rate of %s is not finite', char(drone));
            end
            said = sprintf('{"velocity_m_s":[%.17g,%.17g,%.17g],"yaw_rate_rad_s":%.17g', numbers);
            if nargin > 4
                said = [said ',"frame":' text_of(frame)];
            end
            c.say(['drone/' char(drone) '/cmd/velocity'], [said '}']);
        end

        % Modes, for all drones or for one

        function takeoff(c, varargin), c.mode('takeoff', varargin{:}); end
        function land(c, varargin), c.mode('land', varargin{:}); end
        function emergency(c, varargin), c.mode('emergency', varargin{:}); end
        function reset(c, varargin), c.mode('reset', varargin{:}); end

        function mode(c, mode, drone)
            % MODE Command a mode (takeoff, land, emergency, reset) for one drone, or without drone for all.
            drones = c.run.drones;
            if nargin > 2
                drones = cellstr(drone);
            end
            for k = 1:numel(drones)
                c.put(['drone/' drones{k} '/cmd/mode'], struct('mode', char(mode)));
            end
        end

        % Requests

        function result = ask(c, key, op, args, timeout_s)
            % ASK Send a request on a key, and return the result.
            %
            %   c.ask('world/control', 'rate', struct('value', 2))          % args may be {}
            if nargin < 4 || isempty(args)
                args = struct();
            end
            if nargin < 5
                timeout_s = c.timeout_s;
            end
            said = ['"key":' text_of(key) ',"request":' text_of(op) ',"args":' zsim.encode(args)];
            answer = c.request('ask', sprintf('%s,"timeout_s":%g', said, timeout_s), timeout_s + c.timeout_s);
            if ~answer.ok
                error('zsim:refused', '%s %s: %s', char(key), char(op), answer.error);
            end
            result = answer.result;
        end

        function pause(c), c.ask('world/control', 'pause'); end
        function resume(c), c.ask('world/control', 'resume'); end
        function rate(c, value), c.ask('world/control', 'rate', struct('value', value)); end

        function advance(c, gates)
            % ADVANCE Advance a paused world by a number of gates (default: 1).
            if nargin < 2
                gates = 1;
            end
            c.ask('world/control', 'step', struct('gates', gates));
        end

        function stop(c, reason)
            % STOP End the run.
            if nargin < 2
                reason = ['asked by ' c.name];
            end
            c.ask('world/control', 'stop', struct('reason', char(reason)));
        end

        function acquire(c, drone, priority)
            c.ask('world/control', 'acquire', struct('drone', char(drone), 'priority', priority));
        end

        function release(c, drone)
            c.ask('world/control', 'release', struct('drone', char(drone)));
        end

        % Requests to a formation's controller

        function clusterTarget(c, name, values, over_s)
            % CLUSTERTARGET Lead a formation to given values of its variables, e.g. struct('z_c', 10).
            %
            % over_s is the duration [s]; without it, as fast as allowed. For names with dots, use a containers.Map.
            args = struct('values', values);
            if nargin > 3
                args.over_s = over_s;
            end
            c.ask_cluster(name, 'target', args);
        end

        function clusterTrajectory(c, name, args)
            % CLUSTERTRAJECTORY Lead a formation along a trajectory.
            %
            % args are those of docs/protocol.md, with expressions or waypoints.
            c.ask_cluster(name, 'trajectory', args);
        end

        function clusterTakeoff(c, name), c.ask_cluster(name, 'takeoff', {}); end
        function clusterEngage(c, name), c.ask_cluster(name, 'engage', {}); end
        function clusterHold(c, name), c.ask_cluster(name, 'hold', {}); end
        function clusterRejoin(c, name), c.ask_cluster(name, 'rejoin', {}); end
        function clusterLand(c, name), c.ask_cluster(name, 'land', {}); end

        % The lockstep

        function keys = join(c, name, period_s, reads, gates)
            % JOIN Start a lockstep session: from now on simulated time waits for `step` every period_s.
            %
            %   reads: key expressions of the inputs; gates: keys that complete a gate (see docs/gateway.md)
            % Returns the keys that complete a gate.
            if nargin < 4
                reads = {};
            end
            said = sprintf('"name":%s,"period_s":%.17g,"reads":%s', text_of(name), period_s, texts_of(reads));
            if nargin > 4
                said = [said ',"gates":' texts_of(gates)];
            end
            c.renew();
            c.outputs = {};
            answer = c.talk.sit(said);
            c.name = answer.name;
            keys = reshape(cellstr(answer.gates), 1, []);
        end

        function gate = step(c, outputs)
            % STEP Answer the last gate with everything sent since then, and wait for the next one.
            %
            %   outputs: n x 2 cell of key and value, to be sent as well
            % Returns t_s, t_ns and inputs (struct array: key, value; in time order), or [] when the run is over; `left`
            % is then the reason. After a refused answer the gate is still open: send corrected values, and call `step`
            % again.
            if nargin > 1
                for k = 1:size(outputs, 1)
                    c.put(outputs{k, :});
                end
            end
            said = c.outputs;
            c.outputs = {};
            c.talk.step(said);
            gate = c.talk.gate;
        end

        function leave(c, reason)
            % LEAVE Answer the last gate, and end the session: simulated time no longer waits for this program.
            if nargin < 2
                reason = 'left';
            end
            said = c.outputs;
            c.outputs = {};
            c.talk.rise(said, ['"reason":' text_of(reason)]);
        end

        % The end

        function close(c)
            % CLOSE End the lockstep session, if any, and close the connection.
            try
                if c.talk.seated
                    c.leave('closed');
                end
            catch
                % The connection is lost; there is nothing left to end.
            end
            c.talk.close();
        end

        function delete(c)
            % DELETE Close the connection.
            %
            % If a lockstep session is open, the world acts according to on_death of the scenario.
            if ~isempty(c.talk)
                c.talk.close();
            end
        end
    end

    methods (Access = private)
        function greet(c, given, start)
            % GREET Say hello, and wait for a run until given.wait after start.
            said = ['"name":' text_of(given.name) ',"token":' text_of(given.token)];
            try
                c.know(c.talk.request('hello', said));
                if isempty(c.run)
                    c.talk.await_run(max(0, given.wait - toc(start)), given.wait);
                    c.know(c.talk.request('hello', said));
                end
            catch reason
                c.talk.close();
                rethrow(reason);
            end
        end

        function know(c, hello)
            % KNOW Store what the gateway reports about the run.
            c.name = hello.name;
            c.talk.heed();
            if isempty(hello.run_id)
                return
            end
            clusters = hello.clusters;
            if isempty(clusters)
                clusters = struct('name', {}, 'drones', {});
            end
            c.run = struct('run_id', hello.run_id, 'federation', hello.federation, 'mode', hello.mode, ...
                'gate_s', hello.gate_s, 'drones', {reshape(cellstr(hello.drones), 1, [])}, ...
                'clusters', reshape(clusters, 1, []));
        end

        function renew(c)
            % RENEW Update `run` if another run has begun.
            if c.talk.begun
                c.know(c.talk.request('hello', '"name":""'));
            end
        end

        function answer = request(c, varargin)
            c.renew();
            answer = c.talk.request(varargin{:});
        end

        function say(c, key, json)
            % SAY Publish a value given as JSON; in a gate, with its answer.
            said = ['"key":' text_of(key) ',"value":' json];
            if ~isempty(c.talk.gate)
                c.outputs{end + 1} = ['{' said '}'];
            else
                c.request('put', said);
            end
        end

        function ask_cluster(c, name, op, args)
            c.ask(['cluster/' char(name) '/control'], op, args);
        end
    end
end

function given = options(pairs)
    % OPTIONS Return the options of the constructor, with defaults for those not given.
    given = struct('port', 7470, 'token', getenv('ZSIM_TOKEN'), 'name', '', 'timeout', 10, 'wait', 30);
    if mod(numel(pairs), 2)
        error('zsim:argument', 'options come as name and value, e.g. zsim.Client(''127.0.0.1'', ''Port'', 7470)');
    end
    for k = 1:2:numel(pairs)
        option = lower(char(pairs{k}));
        if ~isfield(given, option)
            error('zsim:argument', 'option ''%s'' is unknown; allowed: Port, Token, Name, Timeout, Wait', ...
                char(pairs{k}));
        end
        given.(option) = pairs{k + 1};
    end
end

function text = text_of(value)
    text = jsonencode(char(value));
end

function text = texts_of(value)
    % TEXTS_OF Return a text, or a cell or string array of texts, as a JSON list.
    text = zsim.encode(reshape(cellstr(value), 1, []));
end
