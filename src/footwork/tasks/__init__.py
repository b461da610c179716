"""The tasks, as pure functions over arrays: what the ant sees, what it is paid for, when an episode ends."""
