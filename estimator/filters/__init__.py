"""The EKF-SLAM filters, and batches of them."""
