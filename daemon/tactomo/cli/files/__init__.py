"""Commands on files: info, import, reconstruct, export, recover."""
