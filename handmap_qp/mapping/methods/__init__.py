"""The mapping methods of the package, a file each."""
