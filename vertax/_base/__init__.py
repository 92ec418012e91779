"""What every other package may use: compiled properties, files that are whole or absent, one shim."""
