/* Start of a program on a Cortex-M4F under semihosting: vectors, the FPU on, then newlib's. */
#include <stdint.h>

extern uint32_t stack_top[];
extern void _start(void);

static void reset(void) {
    *(volatile uint32_t *)0xE000ED88U |= 0xFU << 20; /* CPACR: coprocessors 10 and 11 */
    __asm volatile("dsb\n isb");
    _start();
}

static void halt(void) {
    for (;;) {
    }
}

__attribute__((section(".vectors"), used)) static const void *const vectors[16] = {
    stack_top, (const void *)reset, (const void *)halt, (const void *)halt, (const void *)halt, (const void *)halt,
};
