"""What gyro, accelerometer and motor commands identify without a pose."""
