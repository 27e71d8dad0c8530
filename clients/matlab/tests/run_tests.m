function run_tests(varargin)
    % RUN_TESTS Run the client's tests, or those named: run_tests('test_json').
    %
    % Raises an error at the end if any has failed. These tests need no gateway; tests/system/test_octave.py runs those
    % that do.
    here = fileparts(mfilename('fullpath'));
    addpath(here, fullfile(here, '..'));
    names = varargin;
    if isempty(names)
        found = dir(fullfile(here, 'test_*.m'));
        names = regexprep({found.name}, '\.m$', '');
    end
    failed = 0;
    for k = 1:numel(names)
        try
            feval(names{k});
            fprintf('ok      %s\n', names{k});
        catch reason
            failed = failed + 1;
            fprintf('FAILED  %s: %s\n', names{k}, reason.message);
        end
    end
    if failed
        error('zsim:tests', '%d of %d tests failed', failed, numel(names));
    end
end
