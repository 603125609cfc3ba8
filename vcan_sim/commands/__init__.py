"""Commands of ``vcan-sim``, one module for each command."""
