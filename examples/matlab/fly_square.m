function fly_square(varargin)
    % FLY_SQUARE Fly drone1 along a 2 m square, in lockstep.
    %
    %   fly_square, or fly_square('10.0.0.5', 'Token', 'secret')
    addpath(fullfile(fileparts(mfilename('fullpath')), '..', '..', 'clients', 'matlab'));
    c = zsim.Client(varargin{:});
    corners = [0 0 2; 2 0 2; 2 2 2; 0 2 2; 0 0 2];  % m, in W
    c.join('square', 0.02, {'drone/drone1/truth'});  % simulated time waits for each step
    gate = c.step();
    c.takeoff('drone1');
    while ~isempty(gate) && ~isempty(corners)
        truth = zsim.heard(gate, 'drone/drone1/truth');
        to_go = corners(1, :) - truth.position_m;
        c.velocity('drone1', 0.8 * to_go, 0, 'world');  % part of the answer to this gate
        if norm(to_go) < 0.2
            fprintf('%6.2f s  at %5.2f %5.2f %5.2f m\n', gate.t_s, truth.position_m);
            corners(1, :) = [];
        end
        gate = c.step();  % answers this gate, and waits for the next
    end
    c.land('drone1');
    c.close();
end
