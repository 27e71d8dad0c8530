classdef Conversation < handle
    % Requests and their answers on a gateway's stream, and what comes between them: values, gates, news of the run.
    %
    % One at a time: a request waits for its answer. Gates and news are kept where `gate`, `left` and `begun` show them,
    % values in a queue until somebody takes them.

    properties (SetAccess = private)
        gate = []  % the gate that has come and is not answered yet: t_s, t_ns, inputs
        left = ''  % why a seat in the lockstep is no more; '' while there is one, or was none
        seated = false  % whether there is one
        begun = true  % whether a run has begun since somebody heeded it
        lost = 0  % values that went because they were not taken in time
    end

    properties (Access = private)
        wire
        timeout_s
        queue  % zsim.Queue of lines that are values
        asked = 0  % id of the last request
    end

    properties (Constant, Access = private)
        QUEUE_MAX = 100000  % values that wait to be taken; a drone's sensors of five minutes
        FOREVER_S = 1e9  % a gate is waited for as long as time stands still
    end

    methods
        function talk = Conversation(host, port, timeout_s, wait_s)
            talk.timeout_s = timeout_s;
            talk.queue = zsim.Queue();
            talk.wire = zsim.Wire(host, port, wait_s);
        end

        function answer = request(talk, op, fields, timeout_s)
            % Send a request, its fields as JSON, and return its answer.
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
            % Return the oldest value that was not taken, and its key; both [] if none has come after timeout_s.
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
            % Wait until a run has begun, for timeout_s, which is what is left of wait_s.
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
            % What is to be known of the run that has begun is known.
            talk.begun = false;
        end

        % A seat in the lockstep

        function answer = sit(talk, fields)
            % Join; the first gate may come at any time from then on.
            talk.left = '';
            talk.gate = [];
            answer = talk.request('join', fields);
            talk.seated = true;
        end

        function step(talk, outputs)
            % Answer the gate that is open with outputs (cell of JSON), and wait for the next or the end of the seat.
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
            % Answer the gate that is open, and leave.
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
            % Say done for the gate that is open; return the id of that, 0 where none is.
            id = 0;
            if ~isempty(talk.gate)
                fields = sprintf('"t_ns":%.0f,"outputs":[%s]', talk.gate.t_ns, strjoin(outputs, ','));
                talk.gate = [];
                id = talk.send('done', fields);
            end
        end

        function answer = take_in(talk, line, id)
            % Take in a line: return it if it answers the request of this id, keep what else it brings, else [].
            answer = [];
            if isempty(line)
                return
            elseif strncmp(line, '{"op":"value"', 13)  % not decoded before somebody takes it
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
                    end  % else of a request that was given up
                otherwise
                    if isfield(said, 'id') && isequal(said.id, id)
                        answer = said;
                    end
            end
        end

        function keep(talk, line)
            % Keep a value; when too many wait the oldest goes.
            if talk.queue.count >= talk.QUEUE_MAX
                talk.queue.take();
                talk.lost = talk.lost + 1;
            end
            talk.queue.add(line);
        end
    end
end
