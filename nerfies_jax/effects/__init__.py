"""What a scene may call for beyond a static radiance field, one file each."""
