function message = refused(identifier, action)
    % Run an action that must fail with this identifier; return what the error says.
    try
        action();
    catch reason
        assert(strcmp(reason.identifier, identifier), 'error is %s (%s); must be %s', ...
            reason.identifier, reason.message, identifier);
        message = reason.message;
        return
    end
    error('zsim:tests', 'nothing failed; must fail with %s', identifier);
end
