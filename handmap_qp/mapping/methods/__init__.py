"""The mapping methods that come with the package, a file each."""
