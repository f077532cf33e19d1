"""The public recordings that the project is tested on: where they come from, and how they become its own format."""
