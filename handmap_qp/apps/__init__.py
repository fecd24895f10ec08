"""What users run: the service, live tracking, the view, and the commands of `handmap`."""
