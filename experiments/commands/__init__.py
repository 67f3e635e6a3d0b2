"""What the command line does, one module per command; they load what is heavy."""
