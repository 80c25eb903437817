"""What an IMU says about motion: propagation for filters, pre-integration for optimisers."""
