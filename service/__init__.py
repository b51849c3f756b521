"""The controller daemon, and what records, judges and replays its traffic."""
