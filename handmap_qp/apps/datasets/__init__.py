"""Recordings by the thousand: convert files, and map whole data sets."""
