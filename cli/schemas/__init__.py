"""Keys of the config groups that several commands share, made of the options of the library."""
