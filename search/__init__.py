"""The space, the front, the pick, the report and the deployment bundle."""
