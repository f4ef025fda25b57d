"""The bird's-eye-view evidence sensor and its line of sight."""
