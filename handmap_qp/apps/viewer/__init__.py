"""`handmap view`: both hands, targets, errors and options in a browser."""
