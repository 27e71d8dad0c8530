classdef Queue < handle
    % QUEUE First-in, first-out queue; adding and taking an item take constant time.

    properties (SetAccess = private)
        count = 0
    end

    properties (Access = private)
        full = {}  % complete blocks, oldest first
        growing = {}  % the block to which items are added
        taken = 0  % number of items taken from the oldest block
    end

    properties (Constant, Access = private)
        BLOCK = 256  % items per block; adding copies one block, since Octave copies a cell that is a property
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
            % TAKE Return the oldest item; an error if there is none.
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
