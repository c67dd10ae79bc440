"""What is claimed about `etid.display`, measured."""
