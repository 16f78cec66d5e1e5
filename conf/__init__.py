"""The YAML configuration of the commands; a package so that an installed copy finds its files."""
