classdef Client < handle
    % A client of a running zsim federation, through `zsim gateway`; for MATLAB R2020b or newer and GNU Octave 7.
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
    %       c.velocity('drone1', [0.5 0 0], 0);      % said in a gate, it is part of its answer
    %       gate = c.step();                         % answers this gate, waits for the next
    %   end
    %
    % Keys, messages, units and frames are those of docs/protocol.md. Lists of numbers are rows, 1 x n. Times t_ns are
    % doubles, exact up to 2^53 ns, 104 days.
    %
    % Errors: zsim:connection (no gateway within Wait, or it is gone), zsim:refused (what was asked for; nothing has
    % happened), zsim:timeout (no answer), zsim:argument (a value that cannot be sent, or an unknown option).

    properties (SetAccess = private)
        name = ''  % in whose name it speaks, e.g. client.laptop
        run = []  % run_id, federation, mode, gate_s, drones (cell of names), clusters (struct array: name, drones)
    end

    properties (Dependent)
        left  % why a seat in the lockstep is no more; '' while there is one, or was none
        lost  % values of subscriptions that went because they were not taken in time
    end

    properties (Access = private)
        talk  % zsim.Conversation
        timeout_s
        outputs = {}  % JSON of what is said to the gate that is open
    end

    methods
        function c = Client(host, varargin)
            % Connect to a gateway. Options by name and value:
            %   'Port' (7470), 'Token' (the variable ZSIM_TOKEN), 'Name' (what the gateway calls it),
            %   'Timeout' (10 s, for an answer), 'Wait' (30 s, for the gateway to come up and a run to begin)
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
            % Return the last value of a key, [] if there is none yet; of an expression with *, a struct array of
            % key and value.
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
            % Have every value on a key or expression from now on; take them with `next`.
            c.request('subscribe', ['"key":' text_of(key)]);
        end

        function unsubscribe(c, key)
            c.request('unsubscribe', ['"key":' text_of(key)]);
        end

        function [value, key] = next(c, timeout_s)
            % Return the oldest value of the subscriptions that was not taken, and its key; both [] if none has come
            % after timeout_s (without it: 10 s).
            if nargin < 2
                timeout_s = c.timeout_s;
            end
            [value, key] = c.talk.next(timeout_s);
        end

        % Publications

        function put(c, key, value)
            % Publish a value; t_ns, seq and source may be left out. In a gate it is part of the answer.
            c.say(char(key), zsim.encode(value));
        end

        function velocity(c, drone, velocity_m_s, yaw_rate_rad_s, frame)
            % Fly a velocity [m/s] and turn at a rate [rad/s]; frame 'heading' (forward, left, up) or 'world'.
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

        % Modes, of all drones or of one

        function takeoff(c, varargin), c.mode('takeoff', varargin{:}); end
        function land(c, varargin), c.mode('land', varargin{:}); end
        function emergency(c, varargin), c.mode('emergency', varargin{:}); end
        function reset(c, varargin), c.mode('reset', varargin{:}); end

        function mode(c, mode, drone)
            % Ask for a mode: takeoff, land, emergency or reset; of one drone, or of all.
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
            % Ask whoever answers on a key, e.g. c.ask('world/control', 'rate', struct('value', 2)); args may be {}.
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
            % Let a paused world go on by so many gates (1).
            if nargin < 2
                gates = 1;
            end
            c.ask('world/control', 'step', struct('gates', gates));
        end

        function stop(c, reason)
            % End the run.
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

        % A formation, by its controller

        function clusterTarget(c, name, values, over_s)
            % Lead a formation to values by name, e.g. struct('z_c', 10), in over_s or as fast as allowed; a
            % containers.Map where names have dots.
            args = struct('values', values);
            if nargin > 3
                args.over_s = over_s;
            end
            c.ask_cluster(name, 'target', args);
        end

        function clusterTrajectory(c, name, args)
            % Lead a formation along a trajectory: args as docs/protocol.md gives them, with expressions or waypoints.
            c.ask_cluster(name, 'trajectory', args);
        end

        function clusterTakeoff(c, name), c.ask_cluster(name, 'takeoff', {}); end
        function clusterEngage(c, name), c.ask_cluster(name, 'engage', {}); end
        function clusterHold(c, name), c.ask_cluster(name, 'hold', {}); end
        function clusterRejoin(c, name), c.ask_cluster(name, 'rejoin', {}); end
        function clusterLand(c, name), c.ask_cluster(name, 'land', {}); end

        % The lockstep

        function keys = join(c, name, period_s, reads, gates)
            % Take a seat in the lockstep: from now on simulated time waits for `step` every period_s.
            %   reads: key expressions of what each gate brings; gates: keys that close one (see docs/gateway.md)
            % Returns the keys that close a gate.
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
            % Answer the gate that came last with all that was said in it, and wait for the next.
            %   outputs: n x 2 cell of key and value, more to answer with
            % Returns t_s, t_ns and inputs (struct array: key, value; in order of time); [] when the run is over,
            % `left` then says why. After a refused answer the gate is still open: say it again.
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
            % Answer the gate that came last, and give the seat up: time waits for this program no longer.
            if nargin < 2
                reason = 'left';
            end
            said = c.outputs;
            c.outputs = {};
            c.talk.rise(said, ['"reason":' text_of(reason)]);
        end

        % The end

        function close(c)
            % Leave the lockstep, if it has a seat there, and end the connection.
            try
                if c.talk.seated
                    c.leave('closed');
                end
            catch
                % Nobody is left to be told.
            end
            c.talk.close();
        end

        function delete(c)
            % End the connection; a seat dies with it, and the world does what the scenario's on_death says.
            if ~isempty(c.talk)
                c.talk.close();
            end
        end
    end

    methods (Access = private)
        function greet(c, given, start)
            % Say who it is, and wait for a run, until given.wait after start.
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
            % Take over what the gateway tells of the run.
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
            % Learn of a run that has begun since.
            if c.talk.begun
                c.know(c.talk.request('hello', '"name":""'));
            end
        end

        function answer = request(c, varargin)
            c.renew();
            answer = c.talk.request(varargin{:});
        end

        function say(c, key, json)
            % Publish a value that is JSON already, in a gate with its answer.
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
    % Return the options of the constructor, those given in the place of the defaults.
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
    % Return one text, a cell or a string array of them as a list, of one too.
    text = zsim.encode(reshape(cellstr(value), 1, []));
end
