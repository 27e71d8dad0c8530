function value = heard(gate, key)
    % HEARD Return the newest message on a key among the inputs of a gate, or [] if there is none.
    %
    %   gate = c.step();
    %   e = zsim.heard(gate, 'drone/drone1/estimate');
    at = find(strcmp({gate.inputs.key}, key), 1, 'last');
    if isempty(at)
        value = [];
    else
        value = gate.inputs(at).value;
    end
end
