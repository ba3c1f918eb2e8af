"""The commands of `todframes`; only this package takes a user's paths and prints."""
