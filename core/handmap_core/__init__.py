"""The compiled core of `handmap_qp`, and the Python that a computer needs besides to talk to it.

`core` has the compiled module, `models` what it is made of, `client` the client of the mapping
service (with pyzmq), `se3` poses and rotations, `options` the base of all options, and `errors`
every error. All of it runs with numpy and msgspec alone.
"""
