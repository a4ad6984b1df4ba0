"""The service: open bins, place boxes in them and fetch their plans over HTTP."""
