"""`handmap view`.

Both hands, what the mapping asks of them and how well they do it, in a browser.
"""
