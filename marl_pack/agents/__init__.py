"""The players: policies that turn the state of N bins into an orientation and a cell each."""
