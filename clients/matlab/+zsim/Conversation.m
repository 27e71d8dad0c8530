classdef Conversation < handle
    % CONVERSATION Requests and answers on a gateway's stream, and the messages in between.
    %
    % Only one request is pending at a time. While it waits for its answer, values, gates and news of the run may
    % arrive. Values are queued until they are taken; `gate`, `left` and `begun` show the rest.

    properties (SetAccess = private)
        gate = []  % the gate that has arrived and is not answered yet: t_s, t_ns, inputs
        left = ''  % why the last lockstep session ended; '' during a session, or if there was none
        seated = false  % whether a lockstep session is open
        begun = true  % whether a run has begun since the last call of `heed`
        lost = 0  % number of values dropped because they were not taken in time
    end

    properties (Access = private)
        wire
        timeout_s
        queue  % zsim.Queue of lines that are values
        asked = 0  % id of the last request
    end

    properties (Constant, Access = private)
        QUEUE_MAX = 100000  % maximum number of queued values; five minutes of a drone's sensors
        FOREVER_S = 1e9  % timeout for a gate, since simulated time may stop indefinitely
    end

    methods
        function talk = Conversation(host, port, timeout_s, wait_s)
            talk.timeout_s = timeout_s;
            talk.queue = zsim.Queue();
            talk.wire = zsim.Wire(host, port, wait_s);
        end

        function answer = request(talk, op, fields, timeout_s)
            % REQUEST Send a request, with its fields as JSON, and return its answer.
            if nargin < 4
                timeout_s = talk.timeout_s;
            end
            id = talk.send(op, fields);
            wire = talk.wire;
            start = tic;
            while true
                line = wire.receive(max(0, timeout_s - toc(start)));
                if isempty(line)
                    error('zsim:timeout', '%s: no answer from %s within %g s', op, wire.address, timeout_s);
                end
                answer = talk.take_in(line, id);
                if ~isempty(answer)
                    return
                end
            end
        end

        function [value, key] = next(talk, timeout_s)
            % NEXT Return the oldest value that has not been taken, and its key.
            %
            % Both are [] if there is none within timeout_s.
            value = [];
            key = [];
            start = tic;
            while talk.queue.count == 0
                left_s = timeout_s - toc(start);
                line = talk.wire.receive(max(0, left_s));
                if ~isempty(line)
                    talk.take_in(line, 0);
                elseif left_s <= 0
                    return
                end
            end
            said = zsim.decode(talk.queue.take());
            value = said.value;
            key = said.key;
        end

        function await_run(talk, timeout_s, wait_s)
            % AWAIT_RUN Wait until a run has begun, for at most timeout_s, the rest of wait_s.
            start = tic;
            while ~talk.begun
                line = talk.wire.receive(max(0, timeout_s - toc(start)));
                if isempty(line)
                    error('zsim:timeout', 'no run on the gateway at %s within %g s; start one with: zsim run', ...
                        talk.wire.address, wait_s);
                end
                talk.take_in(line, 0);
            end
        end

        function heed(talk)
            % HEED Record that the client knows of the run that has begun.
            talk.begun = false;
        end

        % The lockstep

        function answer = sit(talk, fields)
            % SIT Join the lockstep; the first gate may arrive at any time from then on.
            talk.left = '';
            talk.gate = [];
            answer = talk.request('join', fields);
            talk.seated = true;
        end

        function step(talk, outputs)
            % STEP Answer the open gate with outputs (cell of JSON); wait for the next gate or the end of the session.
            answered = talk.gate;
            id = talk.answer(outputs);
            try
                while isempty(talk.gate) && isempty(talk.left)
                    if ~talk.seated
                        error('zsim:refused', 'step: has not joined; say join first');
                    end
                    talk.take_in(talk.wire.receive(talk.FOREVER_S), id);
                end
            catch reason
                if strcmp(reason.identifier, 'zsim:refused')
                    talk.gate = answered;
                end
                rethrow(reason);
            end
        end

        function rise(talk, outputs, fields)
            % RISE Answer the open gate, and leave the lockstep.
            talk.answer(outputs);
            talk.request('leave', fields);
            talk.gate = [];
            talk.seated = false;
        end

        function close(talk)
            talk.wire.close();
        end
    end

    methods (Access = private)
        function id = send(talk, op, fields)
            id = talk.asked + 1;
            talk.asked = id;
            talk.wire.send(sprintf('{"op":"%s","id":%d,%s}', op, id, fields));
        end

        function id = answer(talk, outputs)
            % ANSWER Send a done for the open gate; return the id of the done, or 0 if no gate is open.
            id = 0;
            if ~isempty(talk.gate)
                fields = sprintf('"t_ns":%.0f,"outputs":[%s]', talk.gate.t_ns, strjoin(outputs, ','));
                talk.gate = [];
                id = talk.send('done', fields);
            end
        end

        function answer = take_in(talk, line, id)
            % TAKE_IN Return a line if it answers the request with this id, otherwise [].
            %
            % The contents of other lines are stored.
            answer = [];
            if isempty(line)
                return
            elseif strncmp(line, '{"op":"value"', 13)  % decoded only when it is taken
                talk.keep(line);
                return
            end
            said = zsim.decode(line);
            switch said.op
                case 'value'
                    talk.keep(line);
                case 'gate'
                    inputs = zsim.entries(said.inputs);
                    talk.gate = struct('t_s', said.t_ns * 1e-9, 't_ns', said.t_ns, 'inputs', inputs);
                case 'left'
                    talk.left = said.reason;
                    talk.seated = false;
                case 'lost'
                    talk.lost = talk.lost + said.lines;
                case 'run'
                    talk.begun = talk.begun || strcmp(said.state, 'begun');
                case 'error'
                    if ~isfield(said, 'id') || isequal(said.id, id)
                        error('zsim:refused', '%s', said.error);
                    end  % otherwise it is for a request that has timed out
                otherwise
                    if isfield(said, 'id') && isequal(said.id, id)
                        answer = said;
                    end
            end
        end

        function keep(talk, line)
            % KEEP Queue a value; if the queue is full, drop the oldest one.
            if talk.queue.count >= talk.QUEUE_MAX
                talk.queue.take();
                talk.lost = talk.lost + 1;
            end
            talk.queue.add(line);
        end
    end
end
