"""The defocus product's plugins: one file per stage, mathematics in subpackages."""

from workbench.compiled import keep_somewhere

# Before any compiled module is imported: some are read-only, as where a package is root's.
keep_somewhere()
