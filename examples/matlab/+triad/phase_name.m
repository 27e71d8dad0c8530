function name = phase_name(phase)
    % Return the name of a phase as cluster/NAME/state has it.
    names = {'idle', 'taking_off', 'assembling', 'engaged', 'landing', 'held'};
    name = names{phase + 1};
end
