// A frame's planes of Y'CbCr codes, chroma at half size.
#pragma once
#include <stdint.h>

typedef struct {
    uint8_t *y, *u, *v;
    int64_t y_stride, u_stride, v_stride;
    int32_t width, height;
} Picture;
