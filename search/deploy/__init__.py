"""The deployment bundle, one file a target."""
