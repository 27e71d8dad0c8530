classdef Queue < handle
    % First in, first out; adding and taking cost the same however many there are.

    properties (SetAccess = private)
        count = 0
    end

    properties (Access = private)
        full = {}  % blocks, the oldest first
        growing = {}  % the block that is added to
        taken = 0  % of the oldest block
    end

    properties (Constant, Access = private)
        BLOCK = 256  % adding copies one block: Octave copies a cell that is a property
    end

    methods
        function add(queue, item)
            queue.growing{end + 1} = item;
            queue.count = queue.count + 1;
            if numel(queue.growing) >= queue.BLOCK
                queue.full{end + 1} = queue.growing;
                queue.growing = {};
            end
        end

        function item = take(queue)
            % Return the oldest item; an error if there is none.
            if isempty(queue.full)
                queue.full = {queue.growing};
                queue.growing = {};
            end
            oldest = queue.full{1};
            queue.taken = queue.taken + 1;
            queue.count = queue.count - 1;
            item = oldest{queue.taken};
            if queue.taken == numel(oldest)
                queue.full(1) = [];
                queue.taken = 0;
            end
        end
    end
end
