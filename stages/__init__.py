"""The defocus product's plugins: one file per stage, mathematics in subpackages."""
