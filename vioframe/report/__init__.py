"""Files in, tables and plots out. Nothing here runs an estimator."""
