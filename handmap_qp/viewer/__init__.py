"""`handmap view`: both hands, what the mapping asks of them and how well they do it, in a browser."""
