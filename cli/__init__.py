"""The commands of `nsde`: thin shells around the library, the only part that knows Hydra."""
