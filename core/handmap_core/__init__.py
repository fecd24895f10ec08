"""The compiled core of `handmap_qp`, and the Python that a computer needs besides to follow by it.

`run` has what a robot's computer starts with: saved hands, and how they follow. `core` has the
compiled module, `models` what it is made of, `client` the client of the mapping service (with
pyzmq), `se3` poses and rotations, `options` the base of all options, and `errors` every error.
`hands`, `human`, `ik`, `mapping`, `trackers` and `stream` have what runs for every sample, under
the names of the packages of `handmap_qp` that use them. All of it runs with numpy and msgspec
alone.
"""
