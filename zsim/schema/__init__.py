"""Documents that people write.

    yaml_file             YAML, read with limits
    checker               every fault of a document against its type
    plugin                the user's modules and classes that it names
    quantities, message   types of its numbers, and of those of messages

Imports errors.
"""
