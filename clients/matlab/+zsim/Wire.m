classdef Wire < handle
    % WIRE Lines of text over TCP, using MATLAB's tcpclient or Octave's package sockets.
    %
    %   wire = zsim.Wire('127.0.0.1', 7470, 30)      % waits up to 30 s for the port to open
    %   wire.send('{"op":"hello"}')
    %   line = wire.receive(1.0)         % '' if none arrives within 1 s
    %
    % Octave's package instrument-control has a tcpclient too, but a round trip took twice as long with it. In Octave,
    % accessing a property or calling a method takes as long as ten additions, so the code that handles each line is in
    % few functions.
    %
    % Errors: zsim:connection if there is no connection, or it is lost.

    properties (SetAccess = private)
        address  % host:port, for error messages
    end

    properties (Access = private)
        socket = []  % a descriptor in Octave; [] in MATLAB, and once closed
        device = []  % a tcpclient in MATLAB; [] in Octave, and once closed
        lines = {}  % complete lines that have arrived, and are not all returned yet
        taken = 0  % number of these lines already returned
        begun = {}  % pieces of an incomplete line
    end

    methods
        function wire = Wire(host, port, wait_s)
            AGAIN_S = 0.1;  % between two attempts, while a gateway may be starting
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
            % SEND Send a line; text has no newline.
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
            % RECEIVE Return the next line, or '' if none arrives within timeout_s of wall time.
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
            % CLOSE Close the connection; no effect if it is already closed.
            if ~isempty(wire.socket)
                disconnect(wire.socket);
            end
            wire.socket = [];
            wire.device = [];
        end
    end

    methods (Access = private)
        function is_up = dial(wire, host, port)
            % DIAL Return whether a connection was established; raise an error that waiting cannot resolve.
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
            % FILL Wait for complete lines, store them, and return the first one. Each byte is examined once.
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
            % READ Return the bytes that have arrived, or [] if there are none until timeout_s after start.
            SLICE_S = 0.25;  % longest wait without checking for Ctrl-C
            CHUNK = 65536;  % maximum number of bytes read at once
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
        text = char(bytes);  % text in Octave is UTF-8
    end
end

function bytes = available(device, timeout_s, start)
    SPIN_S = 0.002;  % duration of polling without pauses, because a pause takes a millisecond or more
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
        connection = tcpclient(host, port, 'ConnectTimeout', 10);  % for releases without EnableTransferDelay
    end
end
