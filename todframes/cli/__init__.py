"""The commands; the only room that takes a user's paths and prints."""
