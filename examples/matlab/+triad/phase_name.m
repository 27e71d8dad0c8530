function name = phase_name(phase)
    % PHASE_NAME Return the name of a phase, as in cluster/NAME/state.
    names = {'idle', 'taking_off', 'assembling', 'engaged', 'landing', 'held'};
    name = names{phase + 1};
end
