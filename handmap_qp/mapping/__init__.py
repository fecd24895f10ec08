"""The method: from a human sample to the targets and the command of a robot hand."""
