function text = reason(number)
    % REASON Return the text of a fault; '' for 0.
    texts = { ...
        '', ...                                                                 % 0
        'a drone is in another state', ...                                      % 1
        'an estimate is too old', ...                                           % 2
        'an estimate is not finite', ...                                        % 3
        'a position is too uncertain', ...                                      % 4
        'robots are in line or in one place: the formation has no frame', ...   % 5
        'a drone is below the assembly height', ...                             % 6
        'a variable is beyond its bounds', ...                                  % 7
        'sin(beta) min(p, q) is too small', ...                                 % 8
        'roll or pitch of the formation is too large', ...                      % 9
        'the condition number of J^-1 is too large', ...                        % 10
        'two robots are too near to each other', ...                            % 11
        'a robot would be too low', ...                                         % 12
        'too fast for the robots'' limits', ...                                 % 13
        'not in this phase'};                                                   % 14
    text = texts{number + 1};
end
