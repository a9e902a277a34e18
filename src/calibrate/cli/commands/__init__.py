"""The commands, by what they work on; :data:`calibrate.cli.COMMANDS` says where each is."""
