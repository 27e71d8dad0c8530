function test_queue()
    % TEST_QUEUE Test that items leave the queue in the order in which they were added, across its blocks.
    queue = zsim.Queue();
    rand('state', 4);  %#ok<RAND>
    added = 0;
    taken = 0;
    for k = 1:3000
        if rand() < 0.6
            added = added + 1;
            queue.add(added);
        elseif queue.count
            taken = taken + 1;
            assert(queue.take() == taken);
        end
        assert(queue.count == added - taken);
    end
    while queue.count
        taken = taken + 1;
        assert(queue.take() == taken);
    end
    assert(taken == added && added > 1000);
end
