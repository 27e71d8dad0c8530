function round_trip(port, count)
    % ROUND_TRIP Print, as JSON, how long a control loop waits for the gateway, in milliseconds of wall time.
    %
    %   latest  from the request for one key to its decoded value
    %   put     from a velocity command to its answer
    %   gate    from `step` to the next decoded gate: answer, gateway, world (one drone), gateway
    %
    % Needs a run of one drone on this machine, without another commander. Each operation is repeated count times
    % (default: 2000). The results are p50, p99, max, and quiet_p50: the smallest median of ten parts, since a busy
    % machine slows down some of them.
    here = fileparts(mfilename('fullpath'));
    addpath(fullfile(here, '..'));
    if nargin < 2
        count = 2000;
    end
    c = zsim.Client('127.0.0.1', 'Port', port, 'Name', 'round.trip');
    c.join('round.trip', c.run.gate_s, {'drone/drone1/truth', 'drone/drone1/sensor/status'});
    c.step();
    c.takeoff('drone1');
    figures = struct();
    figures.gate_ms = timed(@() stepped(c), count);
    figures.gate_with_command_ms = timed(@() commanded(c), count);
    c.leave();
    figures.latest_ms = timed(@() c.truth('drone1'), count);
    figures.put_ms = timed(@() c.velocity('drone1', [0 0 0], 0), count);
    c.close();
    disp(zsim.encode(figures));
end

function commanded(c)
    c.velocity('drone1', [0.1 0 0], 0);
    stepped(c);
end

function stepped(c)
    assert(~isempty(c.step()), 'zsim:tests', 'the run is over: %s', c.left);
end

function figure = timed(action, count)
    WARM = 50;  % uncounted repetitions, which load and compile code
    ms = zeros(1, count);
    for k = 1 - WARM:count
        start = tic;
        action();
        if k > 0
            ms(k) = 1000 * toc(start);
        end
    end
    parts = sort(reshape(ms(1:10 * floor(count / 10)), [], 10));
    quiet = min(parts(ceil(size(parts, 1) / 2), :));
    ms = sort(ms);
    figure = struct('quiet_p50', quiet, 'p50', ms(ceil(0.5 * count)), 'p99', ms(ceil(0.99 * count)), 'max', ms(end));
end
