"""What the object does: mapped hands with masses, contacts, friction and gravity, in MuJoCo."""
