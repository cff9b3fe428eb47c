"""The course: principles of depth from defocus, each a small pipeline (``workbench teach``)."""
