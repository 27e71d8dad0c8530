function message = refused(identifier, action)
    % REFUSED Run an action that must fail with this identifier; return the error message.
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
