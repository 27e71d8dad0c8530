classdef Wire < handle
    % Lines of text on a TCP connection: MATLAB's tcpclient, or Octave's sockets package.
    %
    %   wire = zsim.Wire('127.0.0.1', 7470, 30)      % waits 30 s for somebody to listen there
    %   wire.send('{"op":"hello"}')
    %   line = wire.receive(1.0)         % '' if none came within 1 s
    %
    % Octave's instrument-control has a tcpclient too, but took twice as long for a round trip. A property or a method
    % costs Octave as much as ten sums, so what each line goes through is written out in few functions.
    %
    % Errors: zsim:connection where there is no connection, or no longer.

    properties (SetAccess = private)
        address  % host:port, for messages
    end

    properties (Access = private)
        socket = []  % of Octave, a descriptor; [] in MATLAB and once closed
        device = []  % of MATLAB, a tcpclient; [] in Octave and once closed
        lines = {}  % whole lines that have come, not all of them handed out
        taken = 0  % how many have
        begun = {}  % pieces of a line that has not ended yet
    end

    methods
        function wire = Wire(host, port, wait_s)
            AGAIN_S = 0.1;  % between two tries: a gateway on its way up is there soon enough, and nobody is flooded
            wire.address = sprintf('%s:%d', host, port);
            start = tic;
            while ~wire.dial(host, port)
                if toc(start) >= wait_s
                    error('zsim:connection', 'nobody answers on %s; start `zsim gateway` there', wire.address);
                end
                pause(AGAIN_S);
            end
        end

        function send(wire, text)
            % Send a line; text is without the newline.
            text = [text char(10)];
            s = wire.socket;
            if isempty(s)
                write(wire.opened(), unicode2native(text, 'UTF-8'));
                return
            end
            count = send(s, text);
            while count > 0 && count < numel(text)
                text = text(count + 1:end);
                count = send(s, text);
            end
            if count < 1
                wire.fail();
            end
        end

        function line = receive(wire, timeout_s)
            % Return the next line, '' if none has come after timeout_s of wall time.
            lines = wire.lines;
            if isempty(lines)
                line = wire.fill(timeout_s);
                return
            end
            taken = wire.taken + 1;
            line = lines{taken};
            wire.taken = taken;
            if taken == numel(lines)
                wire.lines = {};
            end
        end

        function close(wire)
            % End the connection; nothing happens if it is closed.
            if ~isempty(wire.socket)
                disconnect(wire.socket);
            end
            wire.socket = [];
            wire.device = [];
        end
    end

    methods (Access = private)
        function is_up = dial(wire, host, port)
            % Return whether somebody took the connection; what no waiting mends is an error.
            is_up = true;
            try
                if exist('OCTAVE_VERSION', 'builtin')
                    wire.socket = octave_connection(host, port);
                else
                    wire.device = matlab_connection(host, port);
                end
            catch reason
                if strcmp(reason.identifier, 'zsim:connection')
                    rethrow(reason);
                end
                is_up = false;
            end
        end

        function line = fill(wire, timeout_s)
            % Wait for whole lines, keep them, and return the first. Each byte is looked at once.
            line = '';
            start = tic;
            while true
                bytes = wire.read(timeout_s, start);
                if isempty(bytes)
                    return
                end
                ends = find(bytes == 10);
                if ~isempty(ends)
                    break
                end
                wire.begun{end + 1} = bytes;
            end
            line = decoded(wire.socket, [wire.begun{:}, bytes(1:ends(1) - 1)]);
            wire.begun = {bytes(ends(end) + 1:end)};
            if numel(ends) > 1
                wire.lines = arrayfun(@(from, to) decoded(wire.socket, bytes(from:to)), ...
                    ends(1:end - 1) + 1, ends(2:end) - 1, 'UniformOutput', false);
                wire.taken = 0;
            end
        end

        function bytes = read(wire, timeout_s, start)
            % Return what has come, [] if nothing has until timeout_s after start.
            SLICE_S = 0.25;  % longest wait without looking for Ctrl-C
            CHUNK = 65536;  % bytes read at once
            bytes = [];
            s = wire.socket;
            if isempty(s)
                bytes = available(wire.opened(), timeout_s, start);
                return
            end
            while select(s + 1, s, [], [], max(0, min(SLICE_S, timeout_s - toc(start)))) < 1
                if toc(start) >= timeout_s
                    return
                end
            end
            [bytes, count] = recv(s, CHUNK);
            if count < 1
                wire.fail();
            end
        end

        function device = opened(wire)
            device = wire.device;
            if isempty(device)
                error('zsim:connection', 'the connection to %s is closed; make a new zsim.Client', wire.address);
            end
        end

        function fail(wire)
            wire.close();
            error('zsim:connection', 'the gateway on %s closed the connection; make a new zsim.Client', wire.address);
        end
    end
end

function text = decoded(socket, bytes)
    if isempty(socket)
        text = native2unicode(bytes, 'UTF-8');
    else
        text = char(bytes);  % text of Octave is UTF-8
    end
end

function bytes = available(device, timeout_s, start)
    SPIN_S = 0.002;  % asked without a break for so long, because a pause takes a millisecond or more
    bytes = [];
    asked = tic;
    while device.NumBytesAvailable == 0
        if toc(start) >= timeout_s
            return
        elseif toc(asked) > SPIN_S
            pause(0.001);
        end
    end
    bytes = read(device, device.NumBytesAvailable, 'uint8');
end

function s = octave_connection(host, port)
    try
        pkg('load', 'sockets');
    catch
        error('zsim:connection', 'the package sockets is missing; on Debian: apt-get install octave-sockets');
    end
    s = socket(AF_INET, SOCK_STREAM, 0);
    try
        connect(s, struct('addr', host, 'port', port));
    catch reason
        disconnect(s);
        if ~isempty(strfind(reason.message, 'gethostbyname'))
            error('zsim:connection', '%s: no such host', host);
        end
        rethrow(reason);
    end
end

function connection = matlab_connection(host, port)
    try
        connection = tcpclient(host, port, 'ConnectTimeout', 10, 'EnableTransferDelay', false);
    catch
        connection = tcpclient(host, port, 'ConnectTimeout', 10);  % a release that does not know the last option
    end
end
